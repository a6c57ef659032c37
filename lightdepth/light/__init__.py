"""The light of an endoscope, found from a sparse map or from frames with true depth, and the report of it."""
