#!/usr/bin/env python3
"""Opens a page in a headless Chromium and prints its requests and its console messages.

usage: look_at_page.py CHROMIUM PAGE.html|URL WIDTH HEIGHT light|dark [SHOT.png] [PRINT.pdf]

If PAGE is a URL, first answers JavaScript expressions: one expression per line on standard input, one line of JSON per
answer on standard output. The expression `shot FILE.png` takes a picture.

Prints one JSON document: requests (other than the page itself), messages, overflow_px (excess width of the page over
the window). Uses the DevTools protocol over a pipe and needs only Python's standard library.
"""
import base64
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

LIMIT_S = 60.0


class Browser:
    def __init__(self, program, profile):
        to_read, to_write = os.pipe()
        from_read, from_write = os.pipe()
        script = f'exec 3<&{to_read} 4>&{from_write}; exec "$0" "$@"'
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--hide-scrollbars",
                   "--disable-background-networking", "--no-first-run", f"--user-data-dir={profile}", "about:blank"]
        self.process = subprocess.Popen(["bash", "-c", script, program, *options], pass_fds=(to_read, from_write),
                                        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        os.close(to_read)
        os.close(from_write)
        self.out, self.source = to_write, from_read
        os.set_blocking(from_read, False)
        self.rest, self.number, self.events, self.session = b"", 0, [], None

    def call(self, method, **params):
        self.number += 1
        message = {"id": self.number, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.out, json.dumps(message).encode() + b"\0")
        return self.wait(lambda answer: answer.get("id") == self.number)["result"]

    def wait(self, wanted):
        end = time.monotonic() + LIMIT_S
        while time.monotonic() < end:
            for message in self.read():
                if "method" in message:
                    self.events.append(message)
                if "error" in message:
                    raise SystemExit(f"Chromium: {message['error']}")
                if wanted(message):
                    return message
            time.sleep(0.01)
        raise SystemExit(f"Chromium did not answer within {LIMIT_S} s")

    def read(self):
        try:
            self.rest += os.read(self.source, 1 << 20)
        except BlockingIOError:
            pass
        while b"\0" in self.rest:
            message, self.rest = self.rest.split(b"\0", 1)
            yield json.loads(message)


def look(browser, page, width, height, scheme, shot, print_to):
    target = browser.call("Target.createTarget", url="about:blank")["targetId"]
    browser.session = browser.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
    for domain in ["Page", "Network", "Log", "Runtime"]:
        browser.call(f"{domain}.enable")
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 640)
    browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    is_live = page.startswith("http://")
    url = page if is_live else pathlib.Path(page).resolve().as_uri()
    browser.call("Page.navigate", url=url)
    if not any(event["method"] == "Page.loadEventFired" for event in browser.events):
        browser.wait(lambda message: message.get("method") == "Page.loadEventFired")

    def evaluate(expression):
        return browser.call("Runtime.evaluate", returnByValue=True, expression=expression)["result"].get("value")

    def photograph(to):
        data = browser.call("Page.captureScreenshot", format="png", captureBeyondViewport=True)["data"]
        pathlib.Path(to).write_bytes(base64.b64decode(data))
        return to

    for line in sys.stdin if is_live else ():
        answer = photograph(line[5:].strip()) if line.startswith("shot ") else evaluate(line)
        print(json.dumps(answer), flush=True)
    wide = evaluate(f"document.documentElement.scrollWidth - {width}")
    if shot:
        photograph(shot)
    if print_to:
        data = browser.call("Page.printToPDF", printBackground=True, preferCSSPageSize=True)["data"]
        pathlib.Path(print_to).write_bytes(base64.b64decode(data))
    asked = [e["params"]["request"]["url"] for e in browser.events if e["method"] == "Network.requestWillBeSent"]
    # A `data:` URL is part of the page, so nothing is fetched.
    asked = [address for address in asked if address != url and not address.startswith("data:")]
    kinds = ("Log.entryAdded", "Runtime.consoleAPICalled", "Runtime.exceptionThrown")
    said = [e["params"] for e in browser.events if e["method"] in kinds]
    return {"requests": asked, "messages": said, "overflow_px": wide}


def main():
    if len(sys.argv) < 6:
        raise SystemExit(__doc__)
    program, page, width, height, scheme = sys.argv[1:6]
    shot, print_to = (sys.argv[6:] + ["", ""])[:2]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = Browser(program, profile)
        try:
            print(json.dumps(look(browser, page, int(width), int(height), scheme, shot, print_to)))
        finally:
            browser.process.terminate()
            browser.process.wait()


main()
