"""The same rows in a terminal, as plain text and as HTML; what is shown never raises."""

import io
import re

from rich.console import Console
from rich.text import Text

from terrafix.cosim.show.tables import Shown, Table, first, html, named, text

ROWS = [["a", "<b>[red]", "1.5"], ["", "x & y", "-20"]]


def table(**options):
    return Table(["name", "what", "value"], ROWS, words=2, **options)


def test_text_is_aligned_and_takes_markup_for_text():
    assert str(table()) == (
        "name   what       value\n"
        "───────────────────────\n"
        "a      <b>[red]     1.5\n"
        "       x & y        -20"
    )


def test_a_terminal_shows_the_same_rows():
    console = Console(file=io.StringIO(), width=80)
    console.print(table())
    shown = [line.rstrip() for line in console.file.getvalue().splitlines()]
    assert "\n".join(shown) == str(table())


def test_html_is_escaped_and_aligned():
    shown = table()._repr_html_()
    plain = re.sub(r' style="[^"]*"', "", shown)
    assert plain == (
        "<table><thead><tr><th>name</th><th>what</th><th>value</th></tr></thead>"
        "<tbody><tr><td>a</td><td>&lt;b&gt;[red]</td><td>1.5</td></tr>"
        "<tr><td></td><td>x &amp; y</td><td>-20</td></tr></tbody></table>"
    )
    assert shown.count("text-align:right") == 3
    assert shown.count("text-align:left") == 6


def test_lines_of_a_cell_stay_lines_in_html():
    shown = Table(["a"], [["one\n<two>"]])._repr_html_()
    assert "one<br>&lt;two&gt;</td>" in shown


def test_groups_stand_apart():
    grouped = Table(["q", "axis"], [["p", "x"], ["", "y"], ["v", "x"]], grouped=True)
    assert str(grouped).splitlines()[2:] == ["p   x", "    y", "", "v   x"]


def test_long_cells_are_folded_not_cut():
    shown = text([Table(["a", "b"], [["word " * 30, "z" * 100]])])
    assert max(map(len, shown.splitlines())) <= 80
    assert shown.count("word") == 30
    assert shown.count("z") == 100


def test_lines_keep_their_styles_in_html_only():
    line = Text("bold", style="bold").append(" <plain>", style="not bold")
    assert text([line]) == "bold <plain>"
    assert '<span style="font-weight: bold">bold</span> &lt;plain&gt;' in html([line])
    assert "color: #800000" in html([Text("missing", style="red")])
    assert html(["[bold]a"]) == '<div><div style="white-space:pre-wrap">[bold]a</div></div>'


class Broken(Shown):
    """Fails when it is looked at."""

    def _shown(self):
        raise ValueError("no <such>\nthing")


def test_what_cannot_be_shown_says_why():
    assert repr(Broken()) == "<Broken that cannot be shown: ValueError: no <such> thing>"
    assert Broken()._repr_html_() == (
        "<div>Broken that cannot be shown: ValueError: no &lt;such&gt; thing</div>"
    )


def test_long_lists_are_cut_with_a_count_of_two_or_more():
    assert first("abc", 3) == (["a", "b", "c"], 0)
    assert first("abcd", 3) == (["a", "b", "c", "d"], 0)
    assert first("abcde", 3) == (["a", "b", "c"], 2)
    assert named("abcde", 3) == "a, b, c and 2 more"
