"""From echo to fix: images, references, and matching them."""
