"""From pulses to images: echo, focusing, autofocus, and where a radar looks."""
