"""The work behind the commands: files in, files out, progress on the way."""
