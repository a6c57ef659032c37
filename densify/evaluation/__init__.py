"""What is judged against truth, between submaps and by withheld points; its tables and pictures."""

from lightdepth.moved import names_of

__getattr__ = names_of(__name__, "densify.evaluation.errors")
