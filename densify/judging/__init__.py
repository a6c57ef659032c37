"""What is known of a dense map without truth: agreement with the map, with the images, and the verdict."""
