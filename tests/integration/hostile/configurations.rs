//! Tests random configurations. If `check` accepts a configuration, a monitor with this configuration must run without
//! a panic and must be able to restore the state that it has stored.

use super::*;

const REFERENCE: &str = include_str!("../../../docs/src/reference/keys.md");

const TABLES: [&str; 9] = [
    "pack",
    "estimator",
    "transition",
    "capacity",
    "recharge",
    "usable",
    "limits.current",
    "limits.voltage",
    "limits.temperature",
];

/// Rounds of readings per configuration. One of [`LONG_ONE_IN`] configurations runs for [`LONG_ROUNDS`] rounds.
const ROUNDS: usize = 16;
const LONG_ROUNDS: usize = 80;
const LONG_ONE_IN: usize = 8;

struct NumberKey {
    table: &'static str,
    name: &'static str,
    low: f64,
    high: f64,
    is_low_open: bool,
}

/// All numeric keys of the reference page.
fn keys() -> Vec<NumberKey> {
    let (mut keys, mut table) = (Vec::new(), "");
    for line in REFERENCE.lines() {
        if let Some(name) = line.strip_prefix("## `[").and_then(|rest| rest.split(']').next()) {
            table = TABLES.into_iter().find(|known| *known == name).unwrap_or("");
        }
        let mut parts = line.split('|').map(str::trim);
        let (Some(""), Some(name), Some(value)) = (parts.next(), parts.next(), parts.next()) else { continue };
        let Some(range) = value.strip_prefix("a number, ").filter(|_| !table.is_empty()) else { continue };
        let number = |text: &str| text.trim().parse::<f64>().expect("a number in the reference");
        let (low, high, is_low_open) = match range.strip_prefix("above ") {
            Some(open) => {
                let (low, high) = open.split_once(" and at most ").expect("two ends");
                (number(low), number(high), true)
            }
            None => {
                let (low, high) = range.split_once(" to ").expect("two ends");
                (number(low), number(high), false)
            }
        };
        keys.push(NumberKey { table, name: name.trim_matches('`'), low, high, is_low_open });
    }
    assert!(keys.len() > 60, "too few keys read from the reference page: {}", keys.len());
    keys
}

impl NumberKey {
    /// Draws a value within the range: an end, a uniform number, or a number of random order of magnitude.
    fn draw(&self, dice: &mut Dice) -> f64 {
        let least = if self.is_low_open { self.low + 1e-9 * (self.high - self.low).min(1.0) } else { self.low };
        match dice.below(6) {
            0 => least,
            1 => self.high,
            2 => dice.between(least, self.high),
            _ if least < 0.0 => dice.between(least, self.high),
            _ => {
                let from = least.max(1e-12).ln();
                dice.between(from, self.high.ln()).exp().clamp(least, self.high)
            }
        }
    }
}

fn magnitude(dice: &mut Dice, low: f64, high: f64) -> f64 {
    dice.between(low.ln(), high.ln()).exp()
}

/// A random cell model: plausible if `is_usual`, otherwise with absurd values.
fn cell_model(dice: &mut Dice, capacity_ah: f64, is_usual: bool) -> String {
    let (low_ohm, high_ohm) = if is_usual { (1e-4, 0.2) } else { (1e-9, 1e3) };
    let (low_f, high_f) = if is_usual { (1e2, 1e5) } else { (1e-6, 1e12) };
    let row = |dice: &mut Dice, low, high| {
        let values: Vec<String> = (0..3).map(|_| format!("{:e}", magnitude(dice, low, high))).collect();
        format!("[{}]", values.join(", "))
    };
    let mut text = format!(
        "format = 1\nname = \"random\"\nrated_capacity_ah = {capacity_ah:e}\ncapacity_ah = {capacity_ah:e}\nvoltage_min_v = 2.5\n\
         voltage_max_v = 4.3\n[tables]\nsoc = [0, 0.5, 1]\ntemperature_c = [0, 25]\nocv_v = [[3.0, 3.6, 4.1], [3.0, 3.7, 4.2]]\n\
         r0_ohm = [{}, {}]\n",
        row(dice, low_ohm, high_ohm),
        row(dice, low_ohm, high_ohm),
    );
    for _ in 0..=dice.below(3) {
        let rows = [(low_ohm, high_ohm), (low_f, high_f)]
            .map(|(low, high)| format!("{}, {}", row(dice, low, high), row(dice, low, high)));
        text += &format!("[[tables.branches]]\nr_ohm = [{}]\nc_farad = [{}]\n", rows[0], rows[1]);
    }
    if dice.one_in(2) {
        text += &format!(
            "[thermal]\nheat_capacity_j_per_k = {:e}\nresistance_k_per_w = {:e}\n",
            magnitude(dice, 1.0, 1e4),
            magnitude(dice, 0.1, 1e3)
        );
    }
    text
}

/// Returns the texts of a configuration and of its cell model. A random share of the configuration's numeric keys get
/// random values.
fn configuration(dice: &mut Dice, keys: &[NumberKey]) -> (String, String) {
    let is_usual = !dice.one_in(4);
    let capacity_ah = if is_usual { magnitude(dice, 1.0, 100.0) } else { magnitude(dice, 1.1e-3, 0.9e5) };
    let share = [2, 5, 20][dice.below(3)];
    // packwatch compares cells with each other only if the pack has at least three.
    let base = PACK.replace("cells/example_nmc_2600.toml", "cell.toml").replace("cells = 2\n", "cells = 3\n");
    let mut tables: Vec<(&str, String)> = Vec::new();
    for key in keys.iter().filter(|key| key.table != "usable") {
        if dice.one_in(share) {
            let value = match key.name {
                "initial_capacity_ah" => capacity_ah * magnitude(dice, 0.051, 2.95),
                "rated_capacity_ah" => capacity_ah * magnitude(dice, 0.35, 2.95),
                "min_v" | "from_soc" => dice.between(0.0, 0.4),
                "max_v" => dice.between(4.3, 1000.0),
                "min_c" => dice.between(-100.0, -10.0),
                "max_c" | "to_soc" => dice.between(0.5, 1.0) * key.high,
                // These keys are valid only for a cell without a model file.
                "voltage_min_v" | "voltage_max_v" => continue,
                _ => key.draw(dice),
            };
            let line = format!("{} = {value:e}\n", key.name);
            match tables.iter_mut().find(|(table, _)| *table == key.table) {
                Some((_, text)) => *text += &line,
                None => tables.push((key.table, line)),
            }
        }
    }
    if dice.one_in(3) {
        tables.push((
            "usable",
            format!("current_a = {:e}\ntemperature_c = 25.0\ncutoff_v = 3.0\n", dice.between(0.01, 300.0)),
        ));
    }
    if dice.one_in(8) {
        tables
            .iter_mut()
            .filter(|(table, _)| *table == "capacity")
            .for_each(|(_, text)| *text += "method = \"nominal\"\n");
        tables.push(("estimator", "capacity_state = \"held\"\n".to_owned()));
    }
    let mut text = base;
    for (table, lines) in tables {
        let header = format!("[{table}]\n");
        text = match text.find(&header) {
            Some(place) => {
                let (before, after) = text.split_at(place + header.len());
                let own: Vec<&str> = after.lines().take_while(|line| !line.starts_with('[')).collect();
                let is_new = |line: &&str| {
                    let name = line.split('=').next().unwrap_or_default().trim();
                    !own.iter().any(|there| there.split('=').next().unwrap_or_default().trim() == name)
                };
                let lines: String = lines.lines().filter(is_new).map(|line| format!("{line}\n")).collect();
                format!("{before}{lines}{after}")
            }
            None => format!("{text}{header}{lines}"),
        };
    }
    (text, cell_model(dice, capacity_ah, is_usual))
}

/// Feeds random readings to a monitor, then restores the monitor's state.
fn run(config: &MonitorConfig, dice: &mut Dice) -> Result<(), String> {
    let (mut monitor, mut out, encoder) =
        (Monitor::new(config.clone()), Outputs::default(), InputEncoder::new(&config.input));
    let (mut now, mut made, mut current_a) = (Timestamp::from_secs(1.7e9), Vec::new(), 0.0);
    for _ in 0..if dice.one_in(LONG_ONE_IN) { LONG_ROUNDS } else { ROUNDS } {
        if dice.one_in(5) {
            current_a = [0.0, 300.0, -300.0, dice.between(-300.0, 300.0), dice.between(-1.0, 1.0)][dice.below(5)];
        }
        let voltage =
            |dice: &mut Dice| [dice.between(0.0, 5.0), dice.between(3.0, 4.2), dice.between(3.6, 3.7)][dice.below(3)];
        let values = [
            (Channel::Current, (!dice.one_in(9)).then_some(current_a)),
            (Channel::Temperature(SensorIndex(0)), (!dice.one_in(3)).then(|| dice.between(-40.0, 120.0))),
            (Channel::ReportedSoc, Some(0.5)),
            (Channel::CellVoltage(CellIndex(0)), Some(voltage(dice))),
            (Channel::CellVoltage(CellIndex(1)), Some(voltage(dice))),
            (Channel::CellVoltage(CellIndex(2)), Some(voltage(dice))),
        ];
        made.clear();
        encoder.encode(&values, &mut made);
        for (bus, frame) in &made {
            monitor.handle(&Record::frame(now, *bus, frame), &mut out);
        }
        monitor.handle(&Record::tick(now), &mut out);
        now = now.plus_secs([0.1, 1.0, 4.0, 30.0, 3600.0][dice.below(5)]);
        if dice.one_in(60) {
            monitor.handle(&Record::unknown_gap(now), &mut out);
        }
        out.clear();
    }
    let text = serde_json::to_string(&monitor.snapshot()).map_err(|error| error.to_string())?;
    let snapshot: Snapshot = serde_json::from_str(&text).map_err(|error| format!("{error}: {text:.2000}"))?;
    let mut after = Monitor::new(config.clone());
    after.restore(snapshot, Downtime::Seconds(60.0)).map_err(|error| error.to_string())?;
    after.handle(&Record::tick(now), &mut out);
    Ok(())
}

#[test]
fn accepted_configuration_runs_and_restores_state() {
    let wanted: u64 = std::env::var("PACKWATCH_CONFIGS").map_or(2000, |count| count.parse().expect("a number"));
    let first: u64 = std::env::var("PACKWATCH_FIRST").map_or(1, |seed| seed.parse().expect("a number"));
    let keys = keys();
    let dbc =
        DBC.replace(" SG_ Serial : 32|32@1+ (1,0) [0|0] \"\" A", " SG_ Voltage3 : 32|16@1+ (0.0001,0) [0|5] \"V\" A");
    let (mut accepted, mut refused_states) = (0_u64, Vec::new());
    for seed in first..first + wanted {
        let mut dice = Dice::new(seed);
        let (pack, cell) = configuration(&mut dice, &keys);
        let read = |path: &Path| match path.to_str() {
            Some("pack.toml") => Ok(pack.as_bytes().to_vec()),
            Some("pack.dbc") => Ok(dbc.as_bytes().to_vec()),
            _ => Ok(cell.as_bytes().to_vec()),
        };
        let files = ConfigFiles::alone(Path::new("pack.toml"));
        let Ok(config) = config::load_with(&files, &read) else { continue };
        accepted += 1;
        if let Err(error) = run(&config.monitor, &mut dice) {
            refused_states.push(format!("seed {seed}: {error}\n{pack}\n{cell}"));
            if refused_states.len() > 4 {
                break;
            }
        }
    }
    eprintln!("{accepted} of {wanted} configurations accepted, {} refuse their own state", refused_states.len());
    assert!(refused_states.is_empty(), "{}", refused_states.join("\n---\n"));
    assert!(accepted > wanted / 10, "too few configurations are accepted: {accepted} of {wanted}");
}

#[test]
fn extreme_initial_capacity_is_rejected() {
    for (key, table) in [("initial_capacity_ah = 1e-12", "[pack]"), ("initial_capacity_ah = 500", "[pack]")] {
        let text = PACK.replace(table, &format!("{table}\n{key}"));
        let read = |path: &Path| match path.to_str() {
            Some("pack.toml") => Ok(text.as_bytes().to_vec()),
            Some("pack.dbc") => Ok(DBC.as_bytes().to_vec()),
            _ => std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("config").join(path)),
        };
        let Err(faults) = config::load_with(&ConfigFiles::alone(Path::new("pack.toml")), &read) else {
            panic!("{key} is accepted");
        };
        assert!(faults.0.iter().any(|fault| fault.contains("initial_capacity_ah")), "{faults:?}");
    }
    let good = config_texts::load(&format!("{PACK}[estimator]\nmax_information_s = 0.001\n"), DBC);
    assert!(good.monitor.estimator.voltage.max_information_s > 0.0);
}
