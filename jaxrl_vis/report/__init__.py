"""What people look at: curves, videos, the gallery of tasks, the 3-D viewer."""
