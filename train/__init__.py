"""A dataset in, a checkpoint out. Nobody imports it as a library."""
