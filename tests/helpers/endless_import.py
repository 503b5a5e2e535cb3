"""A module whose import does not end; it touches a file when it begins."""

import os
import threading
from pathlib import Path

Path(os.environ["SPACKLE_TEST"]).touch()
threading.Event().wait(600)  # seconds: longer than any test waits for it
