"""Clips: all that only videos from users need, the work of their command included.

Read `predict.py` first: it predicts and completes a clip frame by frame. `files.py` reads clips and
`writer.py` writes them, `complete.py` completes the view of a frame, `flow.py` follows the content
from frame to frame, and with it `alignment.py` keeps depth, and `propagation.py` colours, from
flickering.
"""
