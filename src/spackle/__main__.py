"""`python -m spackle` is `spackle`."""

from spackle.cli import run

if __name__ == "__main__":
    run()
