"""Benchmark scenes for renderers: models, random poses, our images per second, and the lower bound of their arithmetic."""
