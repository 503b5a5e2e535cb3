"""The page, and the server of the page and of the HTTP interface.

Read `create_app` in app.py first. guard.py refuses strangers, uploads.py checks what clients send,
jobs.py keeps the queues and the results, work.py is what a worker process does with a photo, and
decoding.py what one does with an upload.
"""

from spackle.web.app import create_app

__all__ = ["create_app"]
