"""What a run shows: pictures, the page, progress, and the run folder that holds them."""
