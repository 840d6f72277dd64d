"""Pages from templates that lie beside the code that fills them; what is filled in is escaped."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def filled(template: Path, **values: Any) -> str:
    """The text of a template (Jinja, HTML) with `values` in it; a name without a value raises."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(template.parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template.name).render(values)
