"""`spackle evaluate` and `spackle tables`: datasets into figures, tables, sheets and a page."""
