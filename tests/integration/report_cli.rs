//! Runs `packwatch report` as a user does: pages from a replay and from a store, plots, and a real browser if one is
//! installed.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use assert_cmd::cargo::cargo_bin;

fn packwatch(args: &[&str]) -> Output {
    Command::new(cargo_bin("packwatch")).args(args).output().expect("it runs")
}

fn good(args: &[&str]) {
    let output = packwatch(args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
}

fn bad(args: &[&str]) -> String {
    let output = packwatch(args);
    assert!(!output.status.success(), "{args:?}: no failure");
    String::from_utf8(output.stderr).expect("text")
}

fn config() -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config/measured.toml").display().to_string()
}

struct Place(tempfile::TempDir);

impl Place {
    /// Writes a CSV log of a cell that is discharged and charged a few times.
    fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("a folder"));
        let mut text = String::from("time_s,current_a,voltage_v,temperature_c\n");
        let mut soc: f64 = 0.9;
        for second in 0..7_200_u32 {
            let current_a = if second / 900 % 2 == 0 { 2.0 } else { -2.0 };
            soc -= current_a / 3600.0 / 2.6;
            let voltage_v = 3.3 + 0.8 * soc - 0.05 * current_a;
            text.push_str(&format!("{},{current_a},{voltage_v:.4},24.5\n", 1_700_000_000 + second));
        }
        fs::write(place.0.path().join("cell.csv"), text).expect("written");
        place
    }

    fn path(&self, name: &str) -> String {
        self.0.path().join(name).display().to_string()
    }

    fn page(&self, name: &str, args: &[&str]) -> String {
        let out = self.path(name);
        good(&[&["report", "-o", &out], args].concat());
        fs::read_to_string(out).expect("a page")
    }
}

/// Whether the page's text contains a negative zero ("-0", "-0.0", "-0.00" and so on).
fn has_minus_zero(page: &str) -> bool {
    let texts = page.split('<').filter_map(|part| part.split_once('>')).map(|(_, text)| text.replace('\u{2212}', "-"));
    let mut words = texts.flat_map(|text| text.split([' ', ',', '(', ')']).map(str::to_owned).collect::<Vec<_>>());
    words.any(|word| word.strip_prefix("-0").is_some_and(|rest| rest.chars().all(|c| c == '.' || c == '0')))
}

#[test]
fn minus_zero_is_detected() {
    assert!(has_minus_zero("<p>SOC -0.0 %</p>") && has_minus_zero("<text>\u{2212}0</text>"));
    assert!(!has_minus_zero("<path d=\"M-0.0 1\"/><p>-0.01 to -0.5, 10-0</p>"));
}

#[test]
fn replay_report_is_complete_and_reproducible() {
    let place = Place::new();
    let log = place.path("cell.csv");
    let page = place.page("a.html", &["-c", &config(), &log, "--title", "cell <1>"]);
    for part in ["cell &lt;1&gt;", "State of charge over", "Capacity between", "Usable capacity at 2 A", "Innovation"] {
        assert!(page.contains(part), "no {part:?}");
    }
    assert_eq!(
        page.matches("Every \u{b1} is one standard deviation.").count(),
        1,
        "the meaning must be explained exactly once"
    );
    assert!(!has_minus_zero(&page), "-0 in the page");
    for foreign in ["NaN", "<script", "http:", "https:", "url("] {
        assert!(!page.contains(foreign), "{foreign} in the page");
    }
    assert_eq!(page, place.page("b.html", &["-c", &config(), &log, "--title", "cell <1>"]));
    assert!(page.len() < 600_000, "{} bytes", page.len());
}

#[test]
fn store_report_states_unknown_values() {
    let place = Place::new();
    let (log, state) = (place.path("cell.csv"), place.path("state"));
    good(&["replay", "-c", &config(), &log, "--state", &state]);
    let page = place.page("a.html", &["--state", &state]);
    assert!(page.contains("Capacity between") && page.contains("Duration of each charge"));
    assert!(!has_minus_zero(&page), "-0 in the page");
    assert!(page.contains("Unknown: the history contains learned values") && page.contains("all as they were written"));
    assert!(page.contains("The rated capacity is unknown without -c."));
    assert!(page.contains("<td>Remaining life</td><td>The record does not state the capacity at the end of life"));
    assert!(place.page("b.html", &["--state", &state, "-c", &config()]).contains("of 2 Ah rated"));
}

#[test]
fn plots_write_one_svg_per_picture() {
    let place = Place::new();
    let (log, plots, out) = (place.path("cell.csv"), place.path("plots"), place.path("a.html"));
    let config = config();
    let output = packwatch(&["report", "-o", &out, "-c", &config, &log, "--plots", &plots]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let files: Vec<_> = fs::read_dir(&plots).expect("a folder").map(|file| file.expect("a file").path()).collect();
    assert!(files.len() >= 6 && files.iter().all(|path| path.extension().is_some_and(|e| e == "svg")), "{files:?}");
}

#[test]
fn measured_capacities_are_plotted_and_faults_named() {
    let place = Place::new();
    let (log, table) = (place.path("cell.csv"), place.path("measured.csv"));
    fs::write(&table, "time_s,capacity_ah\n1700003000,1.9\n").expect("written");
    let page = place.page("a.html", &["-c", &config(), &log, "--reference", &table]);
    assert!(page.contains("reference 1.900 Ah"));
    fs::write(&table, "time_s,capacity_ah\n1700003000,much\n").expect("written");
    let printed = bad(&["report", "-c", &config(), &log, "--reference", &table, "-o", &place.path("b.html")]);
    assert!(printed.contains("measured.csv:2: column capacity_ah: found \"much\", must be Ah above 0"), "{printed}");
    assert!(bad(&["report", "-o", &place.path("b.html"), "--state", &place.path("none")]).contains("no history found"));
    assert!(bad(&["report", "-c", &config(), &log, "-o", &log]).contains("is an input, must not be the output too"));
}

#[test]
fn life_report_shows_truth_and_forecast() {
    let place = Place::new();
    let [log, truth, events, state] = ["life.log", "truth.csv", "events.jsonl", "state"].map(|name| place.path(name));
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/paper.toml").display().to_string();
    let whole = ["--cycles", "8", "--truth", &truth, "--truth-period", "60"];
    good(&[&["simulate", "paper", "-c", &config, "-o", &log][..], &whole].concat());
    good(&["replay", "-c", &config, &log, "--events", &events, "--state", &state]);
    let text = fs::read_to_string(&events).expect("events");
    let printed = text.lines().map(|line| serde_json::from_str(line).expect("JSON"));
    let mut lives = printed.filter(|event: &serde_json::Value| event["event"] == "remaining_life");
    let last = lives.next_back().expect("a forecast");
    let digits = |name: &str| {
        let value = last[name].as_f64().expect("known");
        if value < 9.95 { format!("{value:.1}") } else { format!("{value:.0}") }
    };
    let words = format!("{} to {} in nine of ten cases", digits("cycles_low"), digits("cycles_high"));
    let median = format!("{} cycles<", digits("cycles"));
    let replayed = place.page("a.html", &["-c", &config, &log, "--reference", &truth]);
    for part in [words.as_str(), &median, "forecast, 5 to 95 %", "end of life", "true (reference)"] {
        assert!(replayed.contains(part), "no {part:?}");
    }
    let stored = place.page("b.html", &["-c", &config, "--state", &state]);
    assert!(
        stored.contains(&words) && stored.contains(&median) && stored.contains("forecast, 5 to 95 %"),
        "no {words:?} from the store"
    );
}

fn browser() -> Option<PathBuf> {
    let folders = std::env::var_os("PATH")?;
    let names = ["chromium", "chromium-browser", "google-chrome"];
    std::env::split_paths(&folders).flat_map(|folder| names.map(|name| folder.join(name))).find(|path| path.is_file())
}

#[test]
fn browser_renders_report_without_faults() {
    let Some(browser) = browser() else {
        println!("skipped: Chromium is not installed");
        return;
    };
    let place = Place::new();
    let (log, state) = (place.path("cell.csv"), place.path("state"));
    good(&["replay", "-c", &config(), &log, "--state", &state]);
    let _ = place.page("replay.html", &["-c", &config(), &log]);
    let _ = place.page("state.html", &["-c", &config(), "--state", &state]);
    let tool = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/tools/look_at_page.py");
    for (page, width, scheme) in
        [("replay.html", "1280", "light"), ("replay.html", "390", "dark"), ("state.html", "390", "light")]
    {
        let mut command = Command::new("python3");
        command.arg(&tool).arg(&browser).arg(place.path(page));
        let output = command.args([width, "900", scheme]).output().expect("python3 runs");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let printed: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        let expected = serde_json::json!({ "requests": [], "messages": [], "overflow_px": 0 });
        assert_eq!(printed, expected, "{page} at {width} pixels, {scheme}");
    }
}
