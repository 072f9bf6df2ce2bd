"""Readers of annotations, one file a form: from what a program exports to images and what is annotated in them."""
