"""The page's JavaScript: a finding about several frames is one line; for a scan that died it says what can be done."""

from __future__ import annotations

import json
import shutil
import subprocess
from importlib.resources import files

import pytest

RUN = """
const lines = [], log = (data, text) => { const item = { text, remove: () => lines.splice(lines.indexOf(item), 1) }; lines.push(item); return item; };
const logFlag = new Function("log", FUNCTION + "; return logFlag")(log);
for (const [check, level, first, frame] of FLAGS) logFlag({ check, level, first, frame, advice: "x" });
console.log(JSON.stringify(lines.map((line) => line.text)));
"""  # noqa: E501
HEADER = """
const made = {}, $ = (name) => made[name] ??= { append() {}, replaceChildren() {} }, element = $, document = { querySelectorAll: () => [] };
const passes = { update() {} }, mayAct = () => false, again = () => "Again.", feed = { close() {} }, curves = { beam: { y: [] } }, COLOURS = {};
let over = false, ended = "", planned = 9, state = "acquiring", rate = null, fit = null, work = null, pausing = false, ledger = { exposed: 5 };
FUNCTIONS
const said = [], told = () => said.push([$("state").textContent, $("said").textContent]);
for (const [status, over, next] of STATES) { header({ frames: 4, free: 1e9, age_s: 1, status, over, next }); told(); }
onEnd(); told();
console.log(JSON.stringify(said));
"""  # noqa: E501


@pytest.mark.skipif(shutil.which("node") is None, reason="no node")
def test_a_crumb_is_one_line_with_its_number_of_frames() -> None:
    script = (files("beamline.features.page") / "static" / "main.js").read_text("utf-8")
    function = script[script.index("const findings") : script.index("function log(data")]
    flags = [("floater", "warn", 43, 60), ("floater", "warn", 61, 62), ("mass", "warn", None, 5)]
    flags += [("mass", "warn", None, 6), ("floater", "warn", 63, 80), ("floater", "warn", 111, 120)]
    code = RUN.replace("FUNCTION", json.dumps(function)).replace("FLAGS", json.dumps(flags))
    done = subprocess.run(["node", "-e", code], capture_output=True, text=True, check=True, timeout=60)
    assert json.loads(done.stdout) == [
        "mass (warn), frame 5: x", "mass (warn), frame 6: x", "floater (warn), 38 frames, 43 to 80: x",
        "floater (warn), 10 frames, 111 to 120: x",
    ]  # fmt: skip


@pytest.mark.skipif(shutil.which("node") is None, reason="no node")
def test_a_scan_that_ended_without_a_word_is_shown_as_it_is_with_what_can_be_done_also_by_a_page_that_ended() -> None:
    script = (files("beamline.features.page") / "static" / "main.js").read_text("utf-8")
    parts = [("let nextStep", "async function begin"), ("function onEnd", "function again")]
    functions = "".join(script[script.index(first) : script.index(last)] for first, last in parts)
    states = [
        ("running", False, ""),
        ("complete", False, ""),
        ("died", True, "Recover it."),
        ("failed", True, "Resume."),
    ]
    code = HEADER.replace("FUNCTIONS", functions).replace("STATES", json.dumps(states))
    done = subprocess.run(["node", "-e", code], capture_output=True, text=True, check=True, timeout=60)
    words, sentences = zip(*json.loads(done.stdout), strict=True)
    assert words == ("acquiring", "acquiring", "died", "failed", "failed")
    assert sentences[2:] == ("Recover it.", "Resume.", "Resume. This page has ended and shows what it had last. Again.")
