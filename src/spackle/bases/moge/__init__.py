"""MoGe-2 predicts metric depth and the focal length from one photo: `base` uses `network`."""
