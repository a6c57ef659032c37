"""The verbs, a module each: options in, one call, files out. Nothing is imported here: --help has to be quick."""
