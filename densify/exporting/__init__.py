"""Dense maps as other programs take them: each module writes what one of them reads."""
