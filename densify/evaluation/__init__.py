"""What is judged against truth, between submaps and by withheld points; its tables and pictures."""
