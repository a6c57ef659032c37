"""`lightdepth import`: a video or a folder -> a sequence of chosen frames, without the patient's name, and a report.

Nothing is imported here: the help of the command line looks into this package and has to be quick.
"""
