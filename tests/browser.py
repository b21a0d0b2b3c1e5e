"""Headless Chromium in which tests open pages, controlled through the DevTools protocol over a pipe."""

import base64
import fcntl
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SECONDS = 60.0  # timeout of an answer
SETTLED = 200  # milliseconds that the scripts of a page may run after loading
# The browser uses descriptors 3 and 4.
START = """import os, sys
for number, end in ((3, 1), (4, 2)):
    os.dup2(int(sys.argv[end]), number)
os.execv(sys.argv[3], sys.argv[3:])"""
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars",
    "--disable-background-networking", "--no-first-run", "--remote-debugging-pipe",
)  # fmt: skip

# Layout errors of a page: overlapping texts, elements that exceed their container, missing pictures.
# Rectangles of text are limited to the visible part of boxes that scroll.
LAYOUT = """(() => {
  const faults = [], wide = document.documentElement.clientWidth, boxes = [];
  if (document.documentElement.scrollWidth > wide + 1)
    faults.push(`${document.documentElement.scrollWidth} px wide in a window of ${wide}`);
  for (const picture of document.images)
    if (!picture.complete || picture.naturalWidth === 0) faults.push(`no picture ${picture.src}`);
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const range = document.createRange();
  const shown = { opacityProperty: true, visibilityProperty: true, contentVisibilityAuto: true };
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    if (!node.data.trim() || !node.parentElement.checkVisibility(shown)) continue;
    let left = 0, top = -Infinity, right = wide, bottom = Infinity, fixed = false;
    for (let box = node.parentElement; box && box !== document.body; box = box.parentElement) {
      const style = getComputedStyle(box), edge = box.getBoundingClientRect();
      fixed ||= style.position === "fixed";
      if (style.overflowX !== "visible")
        [left, right] = [Math.max(left, edge.left), Math.min(right, edge.right)];
      if (style.overflowY !== "visible")
        [top, bottom] = [Math.max(top, edge.top), Math.min(bottom, edge.bottom)];
    }
    if (fixed) continue;
    range.selectNodeContents(node);
    for (const edge of range.getClientRects()) {
      const box = [Math.max(left, edge.left), Math.max(top, edge.top),
                   Math.min(right, edge.right), Math.min(bottom, edge.bottom)];
      if (box[2] - box[0] > 3 && box[3] - box[1] > 3) boxes.push([box, node]);
    }
  }
  boxes.sort(([one], [other]) => one[1] - other[1]);
  for (let i = 0; i < boxes.length; i++)
    for (let j = i + 1; j < boxes.length && boxes[j][0][1] < boxes[i][0][3] - 4; j++) {
      const [one, at] = boxes[i], [other, beside] = boxes[j];
      if (at !== beside && Math.min(one[2], other[2]) - Math.max(one[0], other[0]) > 3)
        faults.push(`"${at.data.trim().slice(0, 40)}" lies on "${beside.data.trim().slice(0, 40)}"`);
    }
  return { faults, texts: boxes.length };
})()"""

# Elements cut by sheets of the given size: elements that exceed the sheet, boxes that would scroll, and
# pictures and table rows that do not fit on a sheet or may be split between two.
PAPER = """(wide, high) => {
  const faults = [];
  for (const one of document.body.querySelectorAll("*")) {
    if (!one.checkVisibility() || one.closest("svg svg, svg g")) continue;
    const style = getComputedStyle(one), box = one.getBoundingClientRect();
    const text = one.textContent.trim().slice(0, 40);
    const name = `${one.tagName.toLowerCase()} ${one.getAttribute("class")} "${text}"`;
    const drawn = ["IMG", "SVG", "FIGURE"].includes(one.tagName.toUpperCase());
    if ((drawn || one.matches("table, tr, pre, p")) && box.width > 0 && box.right > wide + 1)
      faults.push(`${name} ends at ${Math.round(box.right)} px of ${wide}`);
    if (style.overflowX !== "visible" && one.scrollWidth > one.clientWidth + 1 && one.clientWidth > 1)
      faults.push(`${name} hides ${one.scrollWidth - one.clientWidth} px`);
    if ((drawn || one.tagName === "TR") && box.height > high)
      faults.push(`${name} is ${Math.round(box.height)} px high`);
    if (one.matches("figure, tr") && style.breakInside !== "avoid")
      faults.push(`${name} may be broken`);
  }
  return faults;
}"""


class Opened(NamedTuple):
    """Errors and requests of a page after it was opened."""

    errors: list[str]  # errors of scripts, and on the console
    elsewhere: list[str]  # requested addresses that are neither files nor data
    missing: list[str]  # requested addresses that could not be loaded


class Browser:
    """Browser with a single window, which must be closed after use."""

    def __init__(self, folder: Path) -> None:
        """Start the browser; `folder` holds its temporary files."""
        assert CHROMIUM is not None
        ends = (*os.pipe(), *os.pipe())
        # Move the pipe ends above descriptor 4, so that neither end is overwritten before use.
        reads, writes = (fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in (ends[0], ends[3]))
        self._out, self._in = os.fdopen(ends[1], "wb"), os.fdopen(ends[2], "rb", 0)
        flags = (*FLAGS, f"--user-data-dir={folder}")
        with open(folder / "log", "wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", START, str(reads), str(writes), CHROMIUM, *flags],
                pass_fds=(reads, writes), stdout=log, stderr=log,
            )  # fmt: skip
        for end in (reads, writes, ends[0], ends[3]):
            os.close(end)
        os.set_blocking(self._in.fileno(), False)
        self._rest, self._number, self._events, self._session = b"", 0, [], {}
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        attached = self._call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")
        self._call("Page.setLifecycleEventsEnabled", enabled=True)

    def open(self, path: Path, width: int) -> Opened:
        """Load a file in a window of the given width in pixels."""
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
        self._call("Emulation.setDeviceMetricsOverride", **size)
        self._events.clear()
        loader = self._call("Page.navigate", url=path.as_uri())["loaderId"]
        loaded = {"loaderId": loader, "name": "load"}
        self._wait(lambda event: loaded.items() <= event["params"].items())
        self.evaluate(f"new Promise(done => setTimeout(done, {SETTLED}))")
        return _opened(self._events)

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression in the page; wait for the result of a promise."""
        answer = self._call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def click(self, selector: str) -> None:
        """Scroll the first matching element into view and click its centre."""
        x, y = self.evaluate(
            f"""(() => {{ const one = document.querySelector({json.dumps(selector)});
            one.scrollIntoView({{ block: "center", behavior: "instant" }});
            const box = one.getBoundingClientRect();
            return [box.x + box.width / 2, box.y + box.height / 2]; }})()"""
        )
        for kind in ("mousePressed", "mouseReleased"):
            self._call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        self.evaluate(f"new Promise(done => setTimeout(done, {SETTLED}))")

    def printed(self, width: int, height: int) -> tuple[int, list[str]]:
        """Return the number of printed sheets, and the elements cut by sheets of the given size in pixels."""
        self._call("Emulation.setEmulatedMedia", media="print")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self._call("Emulation.setDeviceMetricsOverride", **size)
        faults = self.evaluate(f"({PAPER})({width}, {height})")
        self._call("Emulation.setEmulatedMedia", media="")
        paper = base64.b64decode(self._call("Page.printToPDF", preferCSSPageSize=True)["data"])
        return len(re.findall(rb"/Type\s*/Page\b", paper)), faults

    def close(self) -> None:
        """End the browser."""
        self._session = {}
        self._call("Browser.close")
        self._out.close()
        self._in.close()
        self._process.wait(SECONDS)

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters, **self._session}
        self._out.write(json.dumps(message).encode() + b"\0")
        self._out.flush()
        answer = self._read(lambda values: values.get("id") == message["id"])
        assert "error" not in answer, (method, answer)
        return answer["result"]

    def _wait(self, wanted) -> None:
        if not any(map(wanted, self._events)):
            self._read(lambda told: "method" in told and wanted(told))

    def _read(self, wanted) -> dict[str, Any]:
        """Return the first message that satisfies the condition; store the events received before."""
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            message, found, rest = self._rest.partition(b"\0")
            if not found:
                self._rest += self._in.read(1 << 20) or b""
                time.sleep(0.002)
                continue
            self._rest = rest
            event = json.loads(message)
            if "method" in event:
                self._events.append(event)
            if wanted(event):
                return event
        raise TimeoutError("the browser does not answer")


def _opened(events: list[dict[str, Any]]) -> Opened:
    opened = Opened([], [], [])
    for event in events:
        parameters = event["params"]
        match event["method"]:
            case "Runtime.exceptionThrown":
                opened.errors.append(
                    parameters["exceptionDetails"]["exception"].get("description", "an exception")
                )
            case "Runtime.consoleAPICalled" if parameters["type"] in ("error", "assert"):
                opened.errors.append(json.dumps(parameters["args"]))
            case "Log.entryAdded" if parameters["entry"]["level"] == "error":
                opened.errors.append(json.dumps(parameters["entry"]))
            case "Network.requestWillBeSent" if not parameters["request"]["url"].startswith(
                ("file:", "data:", "blob:")
            ):
                opened.elsewhere.append(parameters["request"]["url"])
            case "Network.loadingFailed" if not parameters.get("canceled"):
                opened.missing.append(parameters["errorText"])
    return opened
