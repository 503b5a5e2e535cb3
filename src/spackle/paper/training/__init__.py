"""`spackle train` trains the residual network (residual.py) or SHARP's decoder (direct_ft.py).

Read train.py first, the loop; then sources.py, where views with holes and targets come from, and
losses.py.
"""
