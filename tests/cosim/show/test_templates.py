"""What is filled into a page cannot be taken for the page, and nothing is left out in silence."""

import jinja2
import pytest

from terrafix.cosim.show.templates import filled


def test_what_is_filled_in_is_escaped(tmp_path):
    template = tmp_path / "page.html.j2"
    template.write_text('<p title="{{ text }}">{{ text }}</p>\n')
    assert filled(template, text='<b>"a" & b</b>') == (
        '<p title="&lt;b&gt;&#34;a&#34; &amp; b&lt;/b&gt;">'
        "&lt;b&gt;&#34;a&#34; &amp; b&lt;/b&gt;</p>\n"
    )


def test_a_name_without_a_value_raises(tmp_path):
    template = tmp_path / "page.html.j2"
    template.write_text("{{ name }}{{ unknown }}")
    with pytest.raises(jinja2.UndefinedError, match="'unknown' is undefined"):
        filled(template, name="x")
