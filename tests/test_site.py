"""Tables of the site in a real browser; the rest of the site is checked by `make docs`."""

import shutil
import subprocess
from pathlib import Path

import pytest

SITE = Path(__file__).parents[1] / ".ci" / "site"
BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
ROWS = ["dense|1294/1300 [99, 100] %|1.00×", "b|3/43 [2, 19] %|8.71×", "c|780/780 [100, 100] %|16.04×"]
ROWS += ["d||9.5×", "e|822/823 [99, 100] %|10.2×", "f|0/43 [0, 8] %|2×"]
PAGE = """<html><body class="md-typeset"><table><thead><tr><th>method</th><th>success</th><th>speed-up</th></tr></thead>
<tbody>{}</tbody></table><script src="vendor/dataTables.min.js"></script><script src="tables.js"></script>
<script>addEventListener("load", () => document.querySelectorAll("th")[{}].click())</script></body></html>"""

pytestmark = [
    pytest.mark.skipif(BROWSER is None, reason="needs Chromium"),
    pytest.mark.skipif(not (SITE / "vendor").exists(), reason="needs `make docs`"),
]


@pytest.mark.parametrize(("column", "order"), [(0, "bcddenseef"), (1, "dfbdenseec"), (2, "densefbdec")])
def test_a_click_on_a_head_sorts_by_what_the_cells_say(column, order, tmp_path):
    shutil.copytree(SITE, tmp_path, dirs_exist_ok=True)
    rows = ("".join(f"<td>{cell}</td>" for cell in row.split("|")) for row in ROWS)
    (tmp_path / "page.html").write_text(PAGE.format("".join(f"<tr>{row}</tr>" for row in rows), column))
    options = [
        "--headless",
        "--no-sandbox",
        "--virtual-time-budget=5000",
        f"--user-data-dir={tmp_path / 'user'}",
    ]
    command = [BROWSER, *options, "--dump-dom", (tmp_path / "page.html").as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120).stdout
    names = [row.split("</td>")[0].rpartition(">")[2] for row in shown.split("<tbody>")[1].split("<tr")[1:]]
    assert "".join(names) == order
