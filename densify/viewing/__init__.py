"""A run in a browser: what is read of it, what is drawn, what is measured, and the server that shows it."""
