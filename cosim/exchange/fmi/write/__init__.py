"""Components and systems written as FMUs: description, C sources, binaries."""
