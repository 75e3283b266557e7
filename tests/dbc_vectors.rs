//! Our decoding against `cantools`, an independent decoder, run live with the interpreter `PACKWATCH_PYTHON` names.
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "a test")]

use std::collections::HashMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use packwatch::can::dbc::{Database, Message};
use packwatch::can::encode::{AlarmFields, IdOverrides, OutputPlan, StatusFields, default_database};
use packwatch::quantity::{CellIndex, Fault, Mode};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// What cantools says to each `name payload` line; `None` when there is no Python with cantools.
fn oracle(dbc: &Path, strict: bool, lines: &[String]) -> Option<Vec<Result<HashMap<String, f64>, String>>> {
    let Some(python) = std::env::var_os("PACKWATCH_PYTHON") else {
        eprintln!("SKIPPED: PACKWATCH_PYTHON names no Python with cantools, nothing was compared");
        return None;
    };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/tools/dbc_oracle.py");
    let mut command = Command::new(python);
    command.arg(script).arg(dbc).args(strict.then_some("strict")).stdin(Stdio::piped()).stdout(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let (mut stdin, text) = (child.stdin.take().unwrap(), lines.join("\n"));
    let writer = std::thread::spawn(move || stdin.write_all(text.as_bytes()).unwrap());
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap();
    assert!(output.status.success());
    let answers: Vec<_> = String::from_utf8(output.stdout).unwrap().lines().map(answer).collect();
    assert_eq!(answers.len(), lines.len());
    Some(answers)
}

fn answer(line: &str) -> Result<HashMap<String, f64>, String> {
    if let Some(error) = line.strip_prefix('!') {
        return Err(error.to_owned());
    }
    let pair = |pair: &str| pair.split_once('=').map(|(name, value)| (name.to_owned(), value.parse().unwrap()));
    Ok(line.split('\t').filter_map(pair).collect())
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn is_there(message: &Message, signal: usize, payload: &[u8]) -> bool {
    message.signals[signal].multiplex.conditions.iter().all(|condition| {
        let code = message.signals[condition.selector].layout.plan().unwrap().raw(payload).unwrap();
        condition.ranges.iter().any(|(low, high)| (*low..=*high).contains(&code))
    })
}

#[test]
fn every_signal_of_the_tesla_dbc_decodes_as_cantools_does() {
    let data = std::env::var_os("PACKWATCH_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let path = data.join("can_ev/tesla_model3.dbc");
    let Ok(bytes) = std::fs::read(&path) else {
        eprintln!("SKIPPED: {} is not there", path.display());
        return;
    };
    let db = Database::parse_bytes(&bytes).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut payloads = Vec::new();
    for (index, message) in db.messages.iter().enumerate() {
        for _ in 0..1000 {
            let mut payload = vec![0; usize::from(message.len_bytes)];
            random.fill_bytes(&mut payload);
            payloads.push((index, payload));
        }
    }
    let lines: Vec<_> = payloads.iter().map(|(m, p)| format!("{} {}", db.messages[*m].name, hex(p))).collect();
    let Some(answers) = oracle(&path, false, &lines) else { return };
    let (mut compared, mut short, mut refused) = (0_u64, 0_u64, 0_u64);
    for ((index, payload), answer) in payloads.iter().zip(&answers) {
        let message = &db.messages[*index];
        let Ok(expected) = answer else {
            refused += 1;
            continue;
        };
        for (_, signal) in message.signals.iter().enumerate().filter(|(n, _)| is_there(message, *n, payload)) {
            let place = format!("{}.{} of {}", message.name, signal.name, hex(payload));
            match signal.layout.plan().unwrap().physical(payload) {
                Err(Fault::ShortFrame) => {
                    assert!(signal.name.starts_with("DI_lash"), "{place} is short");
                    short += 1;
                }
                found => {
                    let (found, wanted) = (
                        found.unwrap(),
                        *expected.get(&signal.name).unwrap_or_else(|| panic!("cantools has no {place}")),
                    );
                    assert!((found - wanted).abs() <= 1e-9 * wanted.abs().max(1e-9), "{place}: {found} for {wanted}");
                    compared += 1;
                }
            }
        }
    }
    eprintln!("compared {compared}, short {short}, payloads cantools refused {refused}");
    assert!(compared > 1_000_000 && short > 0);
}

#[test]
fn frames_of_the_shipped_dbc_decode_in_cantools_within_one_bit() {
    let plan = OutputPlan::new(&default_database().unwrap(), &IdOverrides::default()).unwrap();
    let status = plan.status(&StatusFields {
        soc: Some(0.5432),
        soc_std: Some(2.0),
        mode: Some(Mode::Discharge),
        validity: 1,
        limiting_cell: Some(CellIndex(95)),
        ..Default::default()
    });
    let alarm = |rule| AlarmFields {
        rule,
        state: Some(1),
        severity: Some(2),
        value: Some(1.38),
        threshold: Some(1.4),
        ..Default::default()
    };
    let mut lines = vec![format!("PACKWATCH_Status {}", hex(status.data()))];
    lines.extend((1..=6).map(|rule| format!("PACKWATCH_Alarm {}", hex(plan.alarm(&alarm(rule)).data()))));
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/packwatch.dbc");
    let Some(answers) = oracle(&path, true, &lines) else { return };
    let status = answers[0].as_ref().unwrap();
    assert!((status["Soc"] - 54.32).abs() <= 0.025, "{status:?}");
    assert!((status["SocStd"] - 25.4).abs() < 1e-9, "saturates below not available: {status:?}");
    assert_eq!((status["Mode"], status["Validity"], status["HighestSeverity"]), (3.0, 1.0, 7.0));
    assert_eq!((status["ActiveAlarms"], status["LimitingCell"]), (63.0, 95.0));
    let capacity = answers[1].as_ref().unwrap();
    assert!(
        (capacity["Value_CapacityLow"] - 1.38).abs() < 1e-9 && (capacity["Threshold_CapacityLow"] - 1.4).abs() < 1e-9
    );
    assert_eq!((capacity["Cell"], capacity["Severity"], capacity["State"]), (2047.0, 2.0, 1.0));
    assert!((answers[5].as_ref().unwrap()["Value_InputImplausible"] - 138.0).abs() < 1e-9);
    assert!(answers.iter().all(Result::is_ok));
}
