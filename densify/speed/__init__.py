"""`bench speed`: every stage beside its floor here and a plain reference, and whole runs that costs rest on."""
