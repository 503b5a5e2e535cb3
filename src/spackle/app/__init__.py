"""The work behind the commands predict, render, export, view, weights and demo: files, resuming, reports, progress."""
