"""Made worlds to learn from: furnished rooms with exact depth, seen by several cameras."""
