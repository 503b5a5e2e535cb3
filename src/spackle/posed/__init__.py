"""Several photos with known cameras become one scene: all that only they need.

Read `predict.py` first: `predict_posed` shows the way from a folder to its scene.
"""
