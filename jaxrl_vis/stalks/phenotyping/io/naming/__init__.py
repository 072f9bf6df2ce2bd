"""Camera side and time of an image from the names of files and folders."""
