"""Open the playable page in headless Chromium and compare it with our renderer, policy and physics: `make page-check`.

The site must be built with the page's data: `make page docs`. Each measurement is printed with its bounds. Exit status: 0 all
measurements are within their bounds; 1 one is not, or is missing, or the page does not run; 2 there is no page or no browser.
"""

import argparse
import functools
import http.server
import json
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
# Figure of check.js -> minimum and maximum. For images: fraction of pixels that show another shape, and mean differences.
BOUNDS: dict[str, tuple[float, float]] = {
    "frames": (32, 32),
    "image_edges": (0, 0.002),
    "image_colour": (0, 0.5),
    "image_depth": (0, 0.5),
    "goal_edges": (0, 0.005),
    "goal_colour": (0, 0.5),
    "goal_depth": (0, 0.5),
    "action": (0, 1e-4),
    "chosen_median": (0, 0.02),
    "goal_joints": (0, 0.01),
    "drift": (0, 0.005),
    "goals": (50, 50),
    "success": (0.9, 1),
}


class Handler(http.server.SimpleHTTPRequestHandler):
    """Request handler that serves the site and receives the page's measurements."""

    def __init__(self, *args: Any, results: "queue.Queue[dict[str, Any]]", **options: Any):
        self._results = results
        super().__init__(*args, **options)

    def do_POST(self) -> None:
        """Put the measurements that the page posts as JSON on the queue ``results``."""
        self._results.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.send_response(204)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Suppress the log of requests."""


def measure(site: Path, browser: str, seconds: float) -> dict[str, Any]:
    """Open the page in a browser and return its measurements by name.

    Args:
        site: Folder of the built site.
        browser: Path of a Chromium.
        seconds: Timeout, s.

    Returns:
        The measurements; only ``error``, a message, if the page posts none in time or fails.
    """
    results: queue.Queue[dict[str, Any]] = queue.Queue()
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(site), results=results))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory() as profile:
        address = f"http://127.0.0.1:{server.server_port}/browser.html?check"
        # Nothing but this machine can be reached: the page must work offline.
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"]
        options += ["--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"]
        opened = subprocess.Popen([browser, *options, address], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            return results.get(timeout=seconds)
        except queue.Empty:
            return {"error": f"no result within {seconds:.0f} s"}
        finally:
            opened.terminate()
            opened.wait()
            server.shutdown()


def main() -> int:
    """Check the page, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--site", type=Path, default=ROOT / "build" / "site")
    parser.add_argument("--seconds", type=float, default=300, help="time that the page has")
    options = parser.parse_args()
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        print(f"there is none of {', '.join(BROWSERS)} to open the page with", file=sys.stderr)
        return 2
    if not (options.site / "play" / "data" / "task.json").exists():
        print(f"{options.site} was built without the page's data: make page docs", file=sys.stderr)
        return 2
    measurements = measure(options.site, browser, options.seconds)
    if "error" in measurements:
        print(f"the page does not run: {measurements['error']}", file=sys.stderr)
        return 1
    broken = 0
    for name, value in measurements.items():
        low, high = BOUNDS.get(name, (float("-inf"), float("inf")))
        is_kept = low <= value <= high
        broken += not is_kept
        print(
            f"{name:16} {value:12.6g}"
            + (f"   {low:g} to {high:g}   {'kept' if is_kept else 'BROKEN'}" if name in BOUNDS else "")
        )
    missing = BOUNDS.keys() - measurements.keys()
    if missing:
        print(f"missing: {', '.join(sorted(missing))}", file=sys.stderr)
    return int(bool(broken or missing))


if __name__ == "__main__":
    sys.exit(main())
