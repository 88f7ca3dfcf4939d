"""Files: arrays, video, weights, safe replacing, and progress shown while they are made."""
