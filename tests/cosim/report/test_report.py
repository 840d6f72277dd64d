"""The page of a campaign: whole, self-contained, and shown by a browser without complaint."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest
from campaign_parts import Tripwire, scalar_system

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.campaign.campaign import run_campaign
from terrafix.cosim.lincov.deviations import linear_covariance
from terrafix.cosim.report.figures import save_figures
from terrafix.cosim.report.reading import read_campaign
from terrafix.cosim.report.report import write_report

OPEN_LOOP = Path(__file__).parents[3] / "examples" / "spacecraft_sar_open_loop.toml"
BROWSER = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chrome"))), None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign") / "c"
    run_campaign(scalar_system(tuning=0.25, wall=6.0), runs=200, workers=1, out=folder)
    return folder


@pytest.fixture(scope="module")
def page(folder):
    path, campaign = write_report(folder)
    assert campaign.notes == ["no linear covariance analysis: the system was not read from a file"]
    return path


class Reader(HTMLParser):
    """Collects what a page refers to, and its text."""

    def __init__(self):
        super().__init__()
        self.links, self.text, self.open = [], [], []

    def handle_starttag(self, tag, attrs):
        """Note links."""
        self.links += [v for k, v in attrs if k in ("src", "href", "data")]

    def handle_data(self, data):
        """Note text."""
        self.text.append(data)


def test_the_page_holds_everything_and_needs_nothing(page):
    reader = Reader()
    reader.feed(page.read_text())
    assert all(link.startswith(("data:", "#")) for link in reader.links), reader.links
    text = " ".join("".join(reader.text).split())
    for part in (
        "overconfident",
        "NEES",
        "Error budget",
        "Repeat any member",
        "runs=200, seed=5",
        "Configuration",
        "members that failed".capitalize(),
        "kernels",
    ):
        assert part in text, part
    assert re.search(r"sigma of x .* is .* predicted", text)


@pytest.mark.skipif(BROWSER is None, reason="no browser")
def test_a_browser_shows_the_page(page, tmp_path):
    """Every image is decoded, nothing reports an error, and the page is as wide as its window."""
    probe = tmp_path / "probe.html"
    script = (
        "<script>window.onload=function(){var i=[...document.images];"
        "document.title=JSON.stringify({images:i.length,"
        "decoded:i.filter(x=>x.naturalWidth>300).length,"
        "wide:document.documentElement.scrollWidth>window.innerWidth,"
        "svg:document.querySelectorAll('.graph svg').length})}</script></body>"
    )
    probe.write_text(page.read_text().replace("</body>", script))
    done = subprocess.run(
        [
            *(BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1100,900"),
            *("--virtual-time-budget=8000", "--dump-dom", probe.as_uri()),
        ],
        capture_output=True,
        text=True,
        timeout=90,
        check=True,
    )
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
    assert title, done.stderr[-500:]
    found = json.loads(title[1].replace("&quot;", '"'))
    assert found == {"images": 3, "decoded": 3, "wide": False, "svg": 1}


def test_a_campaign_of_a_date_says_so(tmp_path):
    """Among its facts, and in its configuration in one line."""

    class Dated(Tripwire):
        """Asks what time it is."""

        def validate_epoch(self, epoch):
            assert epoch == "noon by the tower"

    system = scalar_system()
    system.epoch = "noon by the tower"
    system.connect(system["filter"]["truth"], system.add(Dated(), "dated")["u"])
    run_campaign(system, runs=4, workers=1, out=tmp_path / "c")
    path, _ = write_report(tmp_path / "c")
    assert path.read_text().count("noon by the tower") == 2


@pytest.mark.parametrize("form", ["png", "svg"])
def test_single_figures_are_the_same_files_each_time(folder, form, tmp_path):
    part = read_campaign(folder).part("judge")
    first, second = (save_figures(part, tmp_path / n, form=form) for n in "ab")
    assert [p.name for p in first] == [f"x_error.{form}", f"nees.{form}", f"nis.{form}"]
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]


def test_what_is_no_campaign_is_refused(folder, tmp_path):
    with pytest.raises(ConfigurationError, match="holds no campaign"):
        write_report(tmp_path)
    unfinished = tmp_path / "u"
    shutil.copytree(folder, unfinished)
    (unfinished / "result.nc").unlink()
    with pytest.raises(ConfigurationError, match=r"is not complete\n  complete it with"):
        write_report(unfinished)
    (unfinished / "result.nc").write_bytes(b"nothing")
    with pytest.raises(ConfigurationError, match="is damaged"):
        write_report(unfinished)
    with pytest.raises(ConfigurationError, match="there is no folder"):
        write_report(folder, tmp_path / "no" / "report.html")


def test_a_prediction_is_made_once_and_kept(tmp_path, monkeypatch):
    """The second report reads what the first one kept, and a damaged file is made anew."""
    from terrafix.cosim.campaign.batch import FileSource
    from terrafix.cosim.report import report

    source = FileSource(str(OPEN_LOOP), (("case", "TC-2"),))
    folder = tmp_path / "c"
    run_campaign(source, runs=4, duration="16.4", workers=1, out=folder)
    made = []

    def counted(*arguments, **options):
        made.append(linear_covariance(*arguments, **options))
        return made[-1]

    monkeypatch.setattr(report, "linear_covariance", counted)
    first, again = read_campaign(folder), read_campaign(folder)
    report.predict(first)
    report.predict(again)
    assert len(made) == 1
    assert again.notes == []
    assert again.prediction.sigma.tobytes() == made[0].sigma.tobytes()
    (folder / report.LINCOV).write_bytes(b"damaged")
    report.predict(again)
    assert len(made) == 2
