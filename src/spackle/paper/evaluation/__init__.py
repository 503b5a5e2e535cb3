"""The paper's evaluation: datasets, methods, metrics, tables, figures and the efficiency benchmark.

Read evaluate.py first: from options to a folder of results. What it uses:

- datasets/ and case.py: photos with what is known about them;
- methods.py, protocols.py and alignment.py: which views are rendered, and by which methods;
- metrics.py, published_metrics.py and metric_suite.py: what is measured in them;
- measurements.py and folder.py: numbers, and the folder that holds them;
- tables.py, figures.py and report.py: what is made of the numbers;
- bench.py: counts and times.
"""
