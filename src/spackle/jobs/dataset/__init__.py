"""`spackle dataset`: photos into shards of completed views, by one process, many, or a cluster."""
