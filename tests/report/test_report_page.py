"""The page: what is in it, and that a real browser shows it on a phone, without script and with."""

import json
import re
import shutil
from html.parser import HTMLParser

import pytest
from eval_files import chain_line, write_lines, write_plan, write_policy

from lerobot_lansar.benchmark import load_chains
from lerobot_lansar.report.report import ReportConfig, report


class Elements(HTMLParser):
    """Tags and attributes of a page, in order."""

    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def attributes(self, name):
        return [attrs[name] for _, attrs in self.found if name in attrs]


def chains(folder, lengths, policy, videos=(), instead=()):
    """An evaluation of chains 0, 1, … with so many commands fulfilled, and videos of some.

    `instead`: what was done instead of each chain's command that failed, if that is known.
    """
    rows = [chain_line(k, length) for k, length in enumerate(lengths)]
    if instead:
        rows = [
            (seed, chain, [(task, success, task if success else done) for task, success in commands])
            for (seed, chain, commands), done in zip(rows, instead, strict=True)
        ]
    write_lines(folder, rows, policy=policy)
    write_plan(folder, n_episodes=len(lengths), command=f"lansar-eval --policy.path={policy}")
    for number in videos:
        file = folder / f"videos/lh_mtlc_0/eval_episode_{number}.mp4"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    return str(folder)


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """The page of one evaluation of 60 chains."""
    folder = tmp_path_factory.mktemp("single")
    policy = write_policy(folder / "policy", "state", "environment_state")
    instead = [None, "stack_block", None, "turn_on_led", None] * 12
    chains(folder / "eval", [5, 0, 3, 1, 2] * 12, policy, videos=(0, 1), instead=instead)
    report(ReportConfig(str(folder / "eval"), folder / "report"))
    return folder / "report/report.html"


@pytest.fixture(scope="module")
def several(tmp_path_factory):
    """The page of two evaluations with long names, beside published rows."""
    folder = tmp_path_factory.mktemp("several")
    folders = [chains(folder / "a", [5, 0, 3], "p"), chains(folder / "b", [5, 2, 3], "q")]
    labels = ["A_policy_with_a_name_that_is_much_longer_than_a_phone_is_wide", "<b>B</b> & $x$"]
    report(ReportConfig(folders, folder / "report", labels, published="thesis_5.5"))
    return folder / "report/report.html"


def rows(page):
    """Text of every chain's row."""
    body = page.read_text().partition('id="episodes"')[2].partition("<tbody>")[2].partition("</tbody>")[0]
    return [" ".join(re.sub(r"<[^>]+>", " ", row).split()) for row in body.split("<tr ")[1:]]


def test_every_chain_is_listed_failures_first(single):
    listed = rows(single)
    assert len(listed) == 60
    counts = [int(re.search(r"(\d) of 5", row)[1]) for row in listed]
    assert counts == sorted(counts)
    first, second, *_ = load_chains()[1].tasks
    assert f"> 1 ✗ {first} 9 {second} " in listed[0], "number, verdict, steps, and what was never reached"
    assert listed[0].endswith("0 of 5 video")
    assert listed[1].endswith("0 of 5"), "chain 6 has no video"
    five = load_chains()[0].tasks
    assert any(" ".join(f"✓ {task} 9" for task in five) in row for row in listed)


def test_videos_are_linked_relative_to_the_page(single):
    links = [link for link in Elements(single.read_text()).attributes("href") if link.endswith(".mp4")]
    assert sorted(links) == [f"../eval/videos/lh_mtlc_0/eval_episode_{k}.mp4" for k in (0, 1)]
    assert all((single.parent / link).is_file() for link in links)


def test_several_evaluations_have_a_column_each(several):
    assert [re.findall(r"\d of 5", row) for row in rows(several)] == [
        ["0 of 5", "2 of 5"],
        ["3 of 5", "3 of 5"],
        ["5 of 5", "5 of 5"],
    ]
    verdicts = Elements(several.read_text()).attributes("data-v")
    assert verdicts == ["0 2 differ", "3", "5"]


def test_a_chain_that_one_evaluation_lacks_is_called_missing_there(tmp_path):
    folders = [chains(tmp_path / "a", [1, 1], "p"), chains(tmp_path / "b", [1], "q")]
    report(ReportConfig(folders, tmp_path / "out"))
    assert rows(tmp_path / "out/report.html")[1].endswith("1 of 5 ✓ 9 ✗ 9 missing")


def test_the_page_needs_nothing_else(single, several):
    for page in (single, several):
        elements = Elements(page.read_text())
        assert not {"link", "iframe", "object", "embed"} & {tag for tag, _ in elements.found}
        assert elements.attributes("src") == []
        assert not [link for link in elements.attributes("href") if "//" in link]
        assert not re.search(r"url\((?!#)|@import", page.read_text())


def test_ids_are_unique_and_refer_to_something(single, several):
    for page in (single, several):
        text = page.read_text()
        ids = Elements(text).attributes("id")
        assert len(ids) == len(set(ids))
        assert set(re.findall(r"url\(#(\w+)\)", text)) | set(re.findall(r'href="#(\w+)"', text)) <= set(ids)


def test_plots_name_themselves_and_take_the_pages_colours(single):
    text = single.read_text()
    plots = [attrs for tag, attrs in Elements(text).found if tag == "svg"]
    assert [plot["role"] for plot in plots] == ["img", "img", "img"]
    assert plots[2]["aria-label"] == "What policy did, by what it was told"
    assert plots[0]["aria-label"] == "Success of 1 to 5 commands in a row: policy"
    assert "currentColor" in text
    assert ">commands in a row</text>" in text, "text stays text"


def test_what_was_done_stands_beside_what_was_told(single, several):
    told = json.loads((single.parent / "report.json").read_text())["tables"][0]["evaluations"][0]["told"]
    failed = load_chains()[1].tasks[0]
    assert told[failed]["stack_block"] >= 1
    assert sum(sum(done.values()) for done in told.values()) == 180
    sentence = "of 180 commands 132 were carried out, 24 led to nothing and 24 to another task first"
    assert sentence in single.read_text()
    assert sentence in (single.parent / "report.md").read_text()
    assert "Told and done" not in several.read_text(), "older lines do not say"


def test_labels_are_text_not_markup(several):
    text = several.read_text()
    assert "<b>B</b>" not in text
    assert "&lt;b&gt;B&lt;/b&gt; &amp; $x$" in text


def test_the_same_files_give_the_same_page(tmp_path):
    folder = chains(tmp_path / "eval", [5, 0, 3], "p")
    for name in ("one", "two"):
        report(ReportConfig(folder, tmp_path / name))
    assert (tmp_path / "one/report.html").read_text() == (tmp_path / "two/report.html").read_text()


def test_a_thousand_chains_make_a_lean_page(tmp_path):
    folder = chains(tmp_path, [k % 6 for k in range(1000)], "p")
    report(ReportConfig(folder))
    assert (tmp_path / "report.html").stat().st_size < 1_000_000


FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-quic",
)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Headless Chromium, driven by the chromedriver on the PATH."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="pip install selenium")
    program = shutil.which("chromium") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("there is no chromium with a chromedriver on the PATH")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(flag)
    running = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    yield running
    running.quit()


def show(browser, page, width=1280, script=True):
    """Opens a page in a window of that width (CSS pixels)."""
    metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": not script})
    browser.get(page.as_uri())


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("name", ["single", "several"])
def test_nothing_reaches_beyond_the_window(browser, request, width, name):
    show(browser, request.getfixturevalue(name), width)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    beyond = """return [...document.querySelectorAll("main *")].filter(e =>
        !e.closest(".scroll") && e.getBoundingClientRect().right > innerWidth + 1).map(e => e.outerHTML.slice(0, 80))"""
    assert browser.execute_script(beyond) == []


def shown(browser):
    script = "return [...document.querySelectorAll('#episodes tbody tr')].filter(r => r.offsetHeight).length"
    return browser.execute_script(script)


def choose(browser, name, value):
    script = """const field = document.forms.filter.elements[arguments[0]]; field.value = arguments[1];
        field.dispatchEvent(new Event("input", {bubbles: true}))"""
    browser.execute_script(script, name, value)


def test_the_list_is_filtered_by_text_task_and_verdict(browser, single):
    show(browser, single)
    assert shown(browser) == 60
    choose(browser, "verdict", "3")
    assert shown(browser) == 12
    assert browser.find_element("css selector", "#filter output").text == "12 of 60 shown"
    choose(browser, "verdict", "")
    choose(browser, "task", "stack_block")
    with_task = sum("stack_block" in chain.tasks for chain in load_chains()[:60])
    assert 0 < shown(browser) == with_task, "not unstack_block"
    choose(browser, "task", "")
    choose(browser, "text", "OPEN_drawer")
    assert shown(browser) == sum("open_drawer" in chain.tasks for chain in load_chains()[:60])


def test_without_script_everything_is_readable_and_no_dead_controls_show(browser, single):
    show(browser, single, script=False)
    try:
        assert browser.find_element("css selector", "#filter").is_displayed() is False
        assert len(browser.find_elements("css selector", "#episodes tbody tr")) == 60
        assert "0 of 60 chains missing" in browser.find_element("tag name", "main").text
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_and_paper_differ_in_light_and_dark(browser, single, scheme):
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    show(browser, single)
    script = "const s = getComputedStyle(document.body); return [s.color, s.backgroundColor]"
    ink, paper = (sum(map(int, re.findall(r"\d+", colour))) / 3 for colour in browser.execute_script(script))
    assert (ink < 60 and paper > 240) if scheme == "light" else (ink > 200 and paper < 40)
    plot = browser.execute_script("return getComputedStyle(document.querySelector('.plot svg text')).fill")
    assert sum(map(int, re.findall(r"\d+", plot))) / 3 == ink, "the plot's text has the page's colour"


def test_on_paper_there_are_no_controls(browser, single):
    show(browser, single)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        assert browser.find_element("css selector", "#filter").is_displayed() is False
        assert shown(browser) == 60
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
