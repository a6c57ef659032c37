"""A sparse map from frames alone, by pycolmap, where there is no SLAM output."""
