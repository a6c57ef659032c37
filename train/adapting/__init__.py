"""A checkpoint to another endoscope or organ: the module that trains, the map that teaches, the judges."""
