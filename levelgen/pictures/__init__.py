"""Levels as pictures: a scene, drawn in pixels or as SVG."""
