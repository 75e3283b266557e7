//! Tests `packwatch doctor`. One fault of the table `faults` is put into the configuration, the DBC or the log of a
//! healthy simulated pack. The doctor's first finding must be this fault. In healthy packs the doctor must find
//! nothing.

mod bench;
mod cli;
mod faults;
mod missed;

use bench::{Bench, BrokenPack};
use faults::{FAULTS, Fault};
use missed::MISSED;
use packwatch::wiring::{Severity, Topic, WiringReport};

/// First seed. Set `PACKWATCH_FIRST_SEED` to test other packs.
fn first_seed() -> u64 {
    std::env::var("PACKWATCH_FIRST_SEED").ok().and_then(|text| text.parse().ok()).unwrap_or(1)
}

const HEALTHY: &[(Bench, u64)] = &[
    (Bench::Pack12, 6),
    (Bench::Pack96, 2),
    (Bench::Protected, 3),
    (Bench::Total, 4),
    (Bench::Pulses, 5),
    (Bench::Steady, 4),
    (Bench::Charge, 3),
    (Bench::Walk, 4),
    (Bench::Day, 1),
];

fn findings(report: &WiringReport) -> Vec<String> {
    let reported = report.findings.iter().filter(|finding| finding.severity != Severity::Note);
    reported
        .map(|finding| format!("{:?} {:?} {} | {}", finding.severity, finding.topic, finding.title, finding.seen))
        .collect()
}

#[test]
fn healthy_packs_have_no_finding() {
    let (mut logs, mut wrong) = (0, Vec::new());
    for (bench, seeds) in HEALTHY {
        for seed in first_seed()..first_seed() + seeds {
            let report = BrokenPack::of(*bench, seed).report();
            assert!(report.frames > 50, "{bench:?} {seed}: only {} frames", report.frames);
            logs += 1;
            let found = findings(&report);
            if !found.is_empty() {
                wrong.push(format!("{bench:?} seed {seed}: {}", found.join("; ")));
            }
        }
    }
    for (name, change) in missed::HEALTHY {
        let mut broken = BrokenPack::of(Bench::Pack12, first_seed());
        change(&mut broken);
        let found = findings(&broken.report());
        logs += 1;
        if !found.is_empty() {
            wrong.push(format!("{name}: {}", found.join("; ")));
        }
    }
    eprintln!("{logs} healthy logs, {} with a finding", wrong.len());
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(logs >= 20);
}

#[test]
fn dead_last_module_is_only_a_warning() {
    let mut broken = BrokenPack::of(Bench::Pack12, 1);
    broken.data("110", |data| {
        if data[0] > 2 {
            data[2..].fill(0xFF);
        }
    });
    let report = broken.report();
    let found = report.findings.iter().find(|finding| finding.topic == Topic::CellCount).unwrap();
    assert_eq!((found.severity, &*found.title), (Severity::Warning, "the pack may have 9 cells, 12 are configured"));
    assert!(found.advice.as_ref().is_some_and(|advice| advice.contains("count the cells")), "{found:?}");
}

#[test]
fn silent_interface_reports_listening_time() {
    let mut doctor = BrokenPack::of(Bench::Pack12, 1).doctor();
    doctor.handle_listened(60.0);
    let report = doctor.finish();
    let seen = &report.findings[0].seen;
    assert!(seen.contains("no frame on") && seen.contains("in 60 s;"), "{seen}");
    assert_eq!(report.seconds, 60.0);
}

/// Number of cases in which the fault was the first finding, was a later finding, or was missed.
#[derive(Default)]
struct Tally {
    first: usize,
    later: usize,
    missed: usize,
    reported: Vec<String>,
}

fn try_fault(fault: &Fault, bench: Bench, seed: u64, tally: &mut Tally) {
    let mut broken = BrokenPack::of(bench, seed);
    (fault.breaks)(&mut broken);
    let report = broken.report();
    let is_it = |topic| fault.expected.contains(&topic);
    let says = |proposed: &str| {
        let mut changes = report.findings.iter().filter(|f| is_it(f.topic)).flat_map(|f| &f.changes);
        proposed.is_empty() || changes.any(|c| format!("{} = {}", c.key, c.proposed).contains(proposed))
    };
    let reported: Vec<_> = report.findings.iter().filter(|f| f.severity != Severity::Note).collect();
    let is_first = reported.first().is_some_and(|finding| is_it(finding.topic));
    if is_first && says(fault.proposed) {
        tally.first += 1;
        return;
    }
    if reported.iter().any(|finding| is_it(finding.topic)) {
        tally.later += 1;
    } else {
        tally.missed += 1;
    }
    let changes: Vec<_> =
        report.findings.iter().flat_map(|f| &f.changes).map(|c| format!("{}={}", c.key, c.proposed)).collect();
    tally.reported.push(format!("{} on {bench:?} {seed}: {:?} {changes:?}", fault.name, findings(&report)));
}

#[test]
fn injected_fault_is_first_finding() {
    let mut tally = Tally::default();
    for fault in FAULTS.iter().chain(MISSED) {
        for bench in fault.benches {
            for seed in first_seed()..first_seed() + fault.seeds {
                try_fault(fault, *bench, seed, &mut tally);
            }
        }
    }
    let all = tally.first + tally.later + tally.missed;
    eprintln!(
        "{all} broken cases of {} faults: {} found first, {} found after another, {} missed",
        FAULTS.len() + MISSED.len(),
        tally.first,
        tally.later,
        tally.missed
    );
    assert!(tally.reported.is_empty(), "{}", tally.reported.join("\n"));
    assert!(all >= 200, "only {all} cases");
}

#[test]
fn missing_answers_are_found() {
    let mut broken = BrokenPack::of(Bench::Pack12, 1);
    broken.config("\"CellVoltages.CellVoltage{n}\"", "\"Car.Cell{n}\"");
    broken.config.push_str(
        "\n[[input.diagnostic]]\nname = \"Car\"\nrequest = 0x7E4\nresponse = 0x7EC\nservice = 0x22\nidentifier = 1\n\
         signals = [{ name = \"Cell{n}\", numbers = \"1-12\", bit = 32, length = 16, factor = 0.0001 }]\n",
    );
    let found = format!("{:?}", findings(&broken.report()));
    assert!(found.contains("cells 1-12: configured, never received"), "{found}");
}
