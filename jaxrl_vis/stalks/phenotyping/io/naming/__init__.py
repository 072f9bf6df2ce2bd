"""Names of files and folders: which camera they are of, and when an image was taken."""
