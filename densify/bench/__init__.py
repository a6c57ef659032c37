"""The built-in benchmark: synthetic colons made from seeds, every row judged on the same work, two runs compared.

Nothing is imported here: the help of the command line looks into this package and has to be quick.
"""
