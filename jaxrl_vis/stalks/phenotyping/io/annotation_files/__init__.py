"""Annotation readers, one module per format: each parses the export of a labelling program into annotated images."""
