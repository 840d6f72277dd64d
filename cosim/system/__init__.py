"""A system of components: built, wired, dispersed, ordered, checked and drawn."""
