"""`python -m spackle` is `spackle`."""

from spackle.cli import main

if __name__ == "__main__":
    main()
