"""Clips: reading and writing, flow from frame to frame, aligned depth, colours that do not flicker."""
