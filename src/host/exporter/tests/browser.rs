//! Tests the exporter's live page in headless Chromium, with a fake daemon.

use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde_json::{Value, json};

use super::*;
use crate::io::socket::LinkState;
use crate::monitor::Validity;
use crate::quantity::catalogue::{PackValues, Quantity};

struct Browser {
    process: Child,
    questions: Option<ChildStdin>,
    answers: BufReader<ChildStdout>,
}

impl Browser {
    /// Opens a page; `None` = no browser is installed.
    fn open(url: &str, width: u32, scheme: &str) -> Option<Self> {
        let folders = std::env::var_os("PATH")?;
        let names = ["chromium", "chromium-browser", "google-chrome"];
        let program = std::env::split_paths(&folders)
            .flat_map(|folder| names.map(|name| folder.join(name)))
            .find(|path| path.is_file())?;
        let tool = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/tools/look_at_page.py");
        let mut command = Command::new("python3");
        command.arg(tool).arg(program).args([url, &width.to_string(), "900", scheme]);
        let mut process = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("python3 runs");
        let answers = BufReader::new(process.stdout.take().unwrap());
        Some(Self { questions: process.stdin.take(), answers, process })
    }

    /// Evaluates a JavaScript expression in the page.
    fn ask(&mut self, expression: &str) -> Value {
        writeln!(self.questions.as_mut().unwrap(), "{expression}").unwrap();
        self.answer()
    }

    fn answer(&mut self) -> Value {
        let mut line = String::new();
        self.answers.read_line(&mut line).unwrap();
        serde_json::from_str(&line).unwrap_or_else(|error| panic!("{line:?}: {error}"))
    }

    fn wait_for_headline(&mut self, wanted: &str) {
        let end = Instant::now() + Duration::from_secs(20);
        loop {
            let headline = self.ask("document.getElementById('head').textContent");
            if headline == wanted {
                return;
            }
            assert!(Instant::now() < end, "{headline}, must be {wanted}");
            thread::sleep(FakeDaemon::PERIOD);
        }
    }

    fn texts(&mut self, selector: &str) -> Vec<String> {
        let texts = self.ask(&format!("[...document.querySelectorAll('{selector}')].map(it=>it.textContent)"));
        serde_json::from_value(texts).unwrap()
    }

    /// Closes the page. Returns the requests that the page made, its console messages, and by how many pixels it is
    /// wider than the window.
    fn close(mut self) -> Value {
        self.questions = None;
        let report = self.answer();
        assert!(self.process.wait().unwrap().success());
        report
    }
}

fn healthy() -> StatusDocument {
    let mut document = sample(8);
    document.interfaces.iter_mut().for_each(|interface| interface.state = LinkState::Up);
    let cell = document.cells[0].clone();
    for silent in &mut document.cells[6..] {
        (silent.values, silent.trusted) = (cell.values, Some(true));
    }
    (document.alarms.raised, document.alarms.list, document.alarms.unknown) = (0, Vec::new(), Vec::new());
    (document.findings, document.floods) = (Vec::new(), Vec::new());
    document
}

fn unknown() -> StatusDocument {
    let mut document = healthy();
    (document.state, document.pack.validity) = (Validity::Unavailable, Validity::Unavailable);
    document.pack.values = PackValues::default();
    for cell in &mut document.cells {
        (cell.values, cell.trusted) = (Default::default(), None);
    }
    document
}

fn untrusted() -> StatusDocument {
    let mut document = healthy();
    (document.state, document.cells[6].trusted) = (Validity::Untrusted, Some(false));
    document
}

const HEALTHY: &str = "Nothing is wrong";
const GONE: &str = "The daemon does not answer: nothing is known now";

#[test]
fn page_shows_what_the_document_says() {
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("status.sock");
    let daemon = FakeDaemon::start(&socket, unknown());
    let (address, _) = start_exporter(&socket, None);
    let url = format!("http://{address}/");
    let Some(mut browser) = Browser::open(&url, 1120, "light") else {
        println!("skipped: Chromium is not installed");
        return;
    };
    browser.wait_for_headline("Not known to be healthy: the state of the pack is not known: no complete measurement");
    assert_eq!(browser.texts("#now b"), ["unknown"; 4]);
    assert!(browser.texts("#values b").is_empty(), "no value is known");
    assert_eq!(browser.texts("#map .lost").len(), 8);

    daemon.report(healthy());
    browser.wait_for_headline(HEALTHY);
    assert_eq!(browser.texts("#now b"), ["63.2 %", "29.20 V", "12.50 A", "31.3 °C"]);
    assert_eq!(browser.texts("#now small")[0], "60.8 to 65.6 %, cell 1");
    let shown = PackValues::rows().filter(|(row, _)| {
        let is_end = row.key.ends_with("_low") || row.key.ends_with("_high");
        !is_end && !live::KEPT.contains(&row.quantity) && healthy().pack.values.get(row.quantity).is_some()
    });
    assert_eq!(browser.texts("#values b").len(), shown.count());
    assert_eq!(browser.texts("#map .bad, #map .lost").len(), 0);
    let labels = "[...document.querySelectorAll('#map div')].map(it=>it.getAttribute('aria-label'))";
    assert_eq!(browser.ask(labels)[0], "Cell 1: 3.600 V");
    let focus = "document.querySelector('#map div').focus();document.querySelector('#map').dispatchEvent(new \
                 KeyboardEvent('keydown',{key:'ArrowRight'}));document.activeElement.getAttribute('aria-label')";
    assert!(browser.ask(focus).as_str().unwrap().starts_with("Cell 2: 3.604 V"));

    daemon.report(untrusted());
    browser.wait_for_headline("Not trusted: the estimate of cell 7 contradicts the voltages");
    assert_eq!(browser.ask(labels)[6], "Cell 7: 3.600 V, not trusted");

    let mut alarm = untrusted();
    (alarm.alarms, alarm.findings) = (sample(8).alarms, sample(8).findings);
    alarm.interfaces[1].name = "<img src=x>".to_owned();
    alarm.interfaces[1].state = LinkState::Missing;
    daemon.report(alarm.clone());
    browser.wait_for_headline("Severe alarm: capacity low, cell 1: 2.412 Ah, limit 2.500 Ah");
    let rest = browser.texts("#more li");
    let told = format!("finding{}", capitalised(&alarm.findings[0].to_string()));
    assert!(rest[0].starts_with(&told), "{rest:?} must begin with {told}");
    assert!(rest.iter().any(|line| line.contains("Interface <img src=x> is missing")), "{rest:?}");
    assert_eq!(browser.texts("img").len(), 0, "names are text");
    assert!(browser.ask(labels)[0].as_str().unwrap().ends_with("alarm or finding"));

    // Changes the page's own variables: a document that the page cannot read, a clock that was set back, a slow
    // connection.
    daemon.report(healthy());
    browser.wait_for_headline(HEALTHY);
    let mut head =
        |change: &str| browser.ask(&format!("{change};verdict();document.getElementById('head').textContent"));
    assert_eq!(head("doc.cells[3].trusted=null"), "Not known to be healthy: the state of cell 4 is not known");
    let unknown = "Not known to be healthy: the state of the pack is not known: no complete measurement";
    assert_eq!(head("doc.cells[3].trusted=true;doc.state='limited'"), unknown, "a state that the page does not know");
    assert_eq!(head("doc.state='valid';doc.cells=[]"), unknown);
    assert_eq!(head("doc.findings=[{kind:1}]"), "This page cannot read the state of the battery: reload it");
    assert_eq!(head("heardAt[0]+=36e5"), "packwatch cannot be reached: nothing is known now");
    browser.wait_for_headline(HEALTHY);
    let mut head =
        |change: &str| browser.ask(&format!("{change};verdict();document.getElementById('head').textContent"));
    assert_eq!(head("isSlow=true"), "The connection is too slow: nothing is known now");
    browser.wait_for_headline(HEALTHY);

    drop(daemon);
    browser.wait_for_headline(GONE);
    assert_eq!(browser.ask("document.body.classList.contains('old')"), true);
    let mut back = healthy();
    back.pack.values.set(Quantity::Soc, Some((0.5, 0.01)));
    let _daemon = FakeDaemon::start(&socket, back);
    browser.wait_for_headline(HEALTHY);
    assert_eq!(browser.texts("#now b")[0], "50.0 %");
    let mut report = browser.close();
    // On a busy machine, the page may lose the event stream and request it again.
    report["requests"].as_array_mut().unwrap().dedup();
    assert_eq!(report, json!({ "requests": [format!("{url}events")], "messages": [], "overflow_px": 0 }));
}

fn capitalised(text: &str) -> String {
    text[..1].to_uppercase() + &text[1..]
}

#[test]
fn page_fits_phone_and_many_cells() {
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("status.sock");
    let _daemon = FakeDaemon::start(&socket, sample(1024));
    let (address, thread) = start_exporter(&socket, None);
    let url = format!("http://{address}/");
    let Some(mut browser) = Browser::open(&url, 360, "dark") else {
        println!("skipped: Chromium is not installed");
        return;
    };
    browser.wait_for_headline("Severe alarm: capacity low, cell 1: 2.412 Ah, limit 2.500 Ah");
    assert_eq!(browser.texts("#map div").len(), 1024);
    // CPU time is measured, because it does not depend on the load by other programs.
    let spent_ms = || {
        let statistics = std::fs::read_to_string(thread.join("schedstat")).unwrap();
        statistics.split(' ').next().unwrap().parse::<f64>().unwrap() / 1e6
    };
    let before_ms = spent_ms();
    let documents = 30;
    thread::sleep(documents * FakeDaemon::PERIOD);
    let per_document_ms = (spent_ms() - before_ms) / f64::from(documents);
    println!("1,024 cells, one page: {per_document_ms:.2} ms per document, {:.2} % of a core", per_document_ms / 10.0);
    assert!(per_document_ms < 50.0, "more than 5 % of a core at one document a second");
    let report = browser.close();
    assert_eq!((&report["messages"], &report["overflow_px"]), (&json!([]), &json!(0)));
}
