"""The suite of `spackle bench --suite`: every stage timed on the spot, beside the least that it could take."""
