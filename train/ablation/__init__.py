"""What each ingredient of a training recipe is worth, by leaving it out."""
