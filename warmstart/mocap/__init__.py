"""Motion of people, from the files it comes in to clips of our bodies."""
