"""Scenes that try to break the mechanics; each says by which law it is judged."""
