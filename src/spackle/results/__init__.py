"""Results on disk: a photo's folder with its scene, video, pictures and report."""
