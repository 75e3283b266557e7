//! Tests that the monitor learns a cell model from simulated drives and charges if only the cell's label is known.
//!
//! The cell's capacity is below the label's, and its resistances are not typical of its chemistry. The cell runs cycles
//! of the scenario `paper`, with a night between cycles.

use std::path::Path;

use packwatch::alarm::{Change, Rule};
use packwatch::can::Frame;
use packwatch::can::encode::InputEncoder;
use packwatch::cell::chemistry::ResistanceFactors;
use packwatch::cell::own_model::task::FitFindings;
use packwatch::cell::{Branch, CellModel, Chemistry, FleetPrior, Label, OwnModel, Table};
use packwatch::config::{self, ConfigFiles};
use packwatch::filter::ScalarGaussian;
use packwatch::monitor::{Downtime, Event, EventKind, ModelState, Monitor, MonitorConfig, Outputs, Record, Snapshot};
use packwatch::quantity::{BusIndex, CellIndex, Channel, Timestamp};
use packwatch::sim::{Scenario, Settings, Simulation, Wiring};

const RATED_AH: f64 = 5.0;
const TRUE_AH: f64 = 4.7;
const TRUE_RESISTANCE: f64 = 0.7;
/// Pause between two cycles (s).
const NIGHT_S: f64 = 30_000.0;
/// Rest voltage at the end of a deep cycle (V).
const FULL_V: f64 = 4.14;

fn configuration(chemistry: &str) -> MonitorConfig {
    configuration_with(chemistry, "")
}

fn configuration_with(chemistry: &str, more: &str) -> MonitorConfig {
    configuration_from(chemistry, more, None)
}

/// Like [`configuration_with`], with a fleet's prior (`fleet` is the text of its file).
fn configuration_from(chemistry: &str, more: &str, fleet: Option<&str>) -> MonitorConfig {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
    let text = std::fs::read_to_string(folder.join("score.toml")).unwrap();
    let prior = fleet.map_or("", |_| "\nprior = \"fleet.toml\"");
    let label = format!("chemistry = \"{chemistry}\"\nrated_capacity_ah = {RATED_AH}{prior}");
    let text = text.replace("cell_model = \"cells/example_nmc_2600.toml\"", &label) + more;
    let path = folder.join("label.toml");
    let read = |file: &Path| match fleet {
        _ if file == path => Ok(text.clone().into_bytes()),
        Some(fleet) if file.ends_with("fleet.toml") => Ok(fleet.as_bytes().to_vec()),
        _ => std::fs::read(file),
    };
    config::load_with(&ConfigFiles::alone(&path), &read)
        .unwrap_or_else(|faults| panic!("{}", faults.0.join("\n")))
        .monitor
}

fn true_model(config: &MonitorConfig) -> CellModel {
    let scaled = |table: &Table, factor: f64| Table {
        values: table.values.iter().map(|row| row.iter().map(|value| factor * value).collect()).collect(),
    };
    let mut model = config.model.clone();
    model.r0_ohm = scaled(&model.r0_ohm, TRUE_RESISTANCE);
    let branch = |branch: &Branch| Branch {
        r_ohm: scaled(&branch.r_ohm, TRUE_RESISTANCE),
        c_farad: scaled(&branch.c_farad, 1.0 / TRUE_RESISTANCE),
    };
    model.branches = model.branches.iter().map(branch).collect();
    model
}

const DEEP: [(f64, f64); 1] = [(0.08, 0.97)];
/// SOC ranges of partial cycles. Each cycle moves 60 % of the capacity. Every third cycle charges until full.
const PARTIAL: [(f64, f64); 3] = [(0.4, 1.0), (0.1, 0.7), (0.25, 0.85)];

/// Frames of some cycles of a cell with the given capacity (Ah), in time order. The SOC ranges are used in turn.
fn vehicle(
    model: &CellModel,
    config: &MonitorConfig,
    capacity_ah: f64,
    swings: &[(f64, f64)],
    cycles: u64,
) -> Vec<(Timestamp, BusIndex, Frame)> {
    let encoder = InputEncoder::new(&config.input);
    let (mut all, mut frames, mut night_s): (Vec<(Timestamp, BusIndex, Frame)>, _, f64) = (Vec::new(), Vec::new(), 0.0);
    for (seed, swing) in (1..=cycles).zip(swings.iter().cycle()) {
        let mut settings = Settings { seed, cycles: Some(1), ..Settings::of(Scenario::Paper, capacity_ah) };
        settings.sensors.current.offset = 0.0;
        settings.pack.ageing = Default::default();
        (settings.soc_window, settings.pack.initial_soc) = (*swing, swing.1);
        let mut sim = Simulation::new(model.clone(), settings, Wiring::single());
        let mut last = Timestamp::ZERO;
        while let Some(moment) = sim.advance() {
            frames.clear();
            encoder.encode(sim.readings(), &mut frames);
            last = moment.time.plus_secs(night_s);
            all.extend(frames.iter().map(|(bus, frame)| (last, *bus, *frame)));
        }
        night_s = all.first().map_or(0.0, |(first, ..)| last.since(*first)) + NIGHT_S;
    }
    all
}

/// Adds frames at rest after each cycle, as if the vehicle stayed awake for some minutes.
fn with_rests(
    config: &MonitorConfig,
    frames: Vec<(Timestamp, BusIndex, Frame)>,
    voltage_v: f64,
) -> Vec<(Timestamp, BusIndex, Frame)> {
    let encoder = InputEncoder::new(&config.input);
    let rest = [(Channel::Current, Some(0.0)), (Channel::CellVoltage(CellIndex(0)), Some(voltage_v))];
    let mut resting = Vec::new();
    encoder.encode(&rest, &mut resting);
    let ends = frames.iter().zip(frames.iter().skip(1)).filter(|(a, b)| b.0.since(a.0) >= NIGHT_S).map(|(a, _)| a.0);
    let ends: Vec<Timestamp> = ends.chain(frames.last().map(|frame| frame.0)).collect();
    let mut all = frames;
    for end in ends {
        let seconds = (1..=240).map(|second| end.plus_secs(f64::from(second)));
        all.extend(seconds.flat_map(|time| resting.iter().map(move |(bus, frame)| (time, *bus, *frame))));
    }
    all.sort_by_key(|frame| frame.0);
    all
}

struct Live {
    monitor: Monitor,
    out: Outputs,
    said: Vec<String>,
    events: Vec<Event>,
}

impl Live {
    fn new(config: &MonitorConfig) -> Self {
        let out = Outputs { want_estimates: true, ..Outputs::default() };
        Self { monitor: Monitor::new(config.clone()), out, said: Vec::new(), events: Vec::new() }
    }

    fn restored(config: &MonitorConfig, snapshot: Snapshot) -> Self {
        let mut live = Self::new(config);
        live.monitor.restore(snapshot, Downtime::AsStamped).expect("restores its own state");
        live
    }

    fn take(&mut self, (time, bus, frame): &(Timestamp, BusIndex, Frame)) {
        while let Some(due) = self.monitor.next_due().filter(|due| due <= time && time.since(*due) < 60.0) {
            self.give(Record::tick(due));
        }
        self.give(Record::frame(*time, *bus, frame));
    }

    fn give(&mut self, record: Record) {
        self.monitor.handle(&record, &mut self.out);
        self.said.extend(self.out.frames.iter().map(|frame| format!("{frame:?}")));
        self.said.extend(self.out.estimates.iter().map(|estimate| format!("{estimate:?}")));
        // Skip outlooks. Their energy depends on the average load, which differs after a restart.
        let is_exact = |event: &&Event| !matches!(event.kind, EventKind::Outlook { .. });
        self.said.extend(self.out.events.iter().filter(is_exact).map(|event| format!("{event:?}")));
        self.events.append(&mut self.out.events);
        self.out.clear();
    }
}

#[test]
fn model_is_learned_at_night_with_true_capacity() {
    let config = configuration("nmc811-graphite");
    let mut live = Live::new(&config);
    vehicle(&true_model(&config), &config, TRUE_AH, &DEEP, 4).iter().for_each(|frame| live.take(frame));
    let view = live.monitor.model();
    assert!(matches!(view.state, ModelState::Learning | ModelState::Learned), "{:?}", view.state);
    let own = view.own.expect("a learned model");
    let off = (own.capacity.mean - TRUE_AH) / own.capacity.std();
    assert!(off.abs() < 1.96 && own.capacity.std() < 0.05 * TRUE_AH, "{:?}", own.capacity);
    assert!(view.fits >= 2 && view.taken_back == 0, "{} fits, {} reverted", view.fits, view.taken_back);
    let published = live.monitor.capacity(CellIndex(0));
    assert!((published.mean - TRUE_AH).abs() < 1.96 * published.std(), "{published:?}");
    let learned_at = |event: &Event| matches!(event.kind, EventKind::Model { .. }).then_some(event.time);
    let is_gap = |event: &Event| matches!(event.kind, EventKind::Gap { .. }).then_some(event.time);
    let gaps: Vec<Timestamp> = live.events.iter().filter_map(is_gap).collect();
    for time in live.events.iter().filter_map(learned_at) {
        let nearest_s = gaps.iter().map(|gap| gap.since(time).abs()).fold(f64::MAX, f64::min);
        assert!(nearest_s < NIGHT_S + 60.0, "a model changed while driving, {nearest_s} s from a night");
    }
}

#[test]
fn capacity_learned_with_model_is_judged_at_once() {
    let limit_ah = 0.5 * (RATED_AH + TRUE_AH) + 0.1;
    let rule = format!("\n[[alarm]]\nrule = \"capacity_low\"\nwarning = {limit_ah}\n");
    let config = configuration_with("nmc811-graphite", &rule);
    let mut live = Live::new(&config);
    vehicle(&true_model(&config), &config, TRUE_AH, &DEEP, 2).iter().for_each(|frame| live.take(frame));
    let learned = live.events.iter().find_map(|event| match event.kind {
        EventKind::Model { capacity_ah: Some(capacity_ah), .. } => Some((event.time, capacity_ah)),
        _ => None,
    });
    let alarm = live.events.iter().find_map(|event| match event.kind {
        EventKind::Alarm { rule: Rule::CapacityLow, change: Change::Raised, value, .. } => Some((event.time, value?)),
        _ => None,
    });
    let ((learned_at, capacity_ah), (raised_at, value)) = (learned.expect("a model"), alarm.expect("an alarm"));
    assert!(
        capacity_ah < limit_ah && raised_at == learned_at,
        "{capacity_ah} at {learned_at:?}, alarm at {raised_at:?}"
    );
    assert!((value - capacity_ah).abs() < 1e-6, "{value} {capacity_ah}");
}

#[test]
fn five_partial_cycles_reveal_wrong_label() {
    let config = configuration("nmc811-graphite");
    for capacity_ah in [0.9 * RATED_AH, 1.1 * RATED_AH] {
        let mut live = Live::new(&config);
        vehicle(&true_model(&config), &config, capacity_ah, &PARTIAL, 5).iter().for_each(|frame| live.take(frame));
        let capacity = live.monitor.capacity(CellIndex(0));
        let off = capacity.mean - capacity_ah;
        assert!(
            off.abs() < 1.96 * capacity.std() && off.abs() < 0.03 * capacity_ah,
            "{capacity_ah}: {capacity:?}, {} fits",
            live.monitor.model().fits
        );
        let is_unfit = |event: &Event| matches!(event.kind, EventKind::Model { state: ModelState::Unfit, .. });
        assert!(!live.events.iter().any(is_unfit), "{capacity_ah}: another chemistry was reported");
    }
}

#[test]
fn restored_state_continues_learning_unchanged() {
    let config = configuration("nmc811-graphite");
    let frames = vehicle(&true_model(&config), &config, TRUE_AH, &DEEP, 3);
    let mut whole = Live::new(&config);
    let (mut twin, mut from): (Option<Live>, usize) = (None, 0);
    for (at, frame) in frames.iter().enumerate() {
        // Seven times, restore a second monitor (the twin) from a stored state, and compare it with the uninterrupted
        // monitor.
        if at % (frames.len() / 7) == frames.len() / 14 {
            twin = Some(Live::restored(&config, whole.monitor.snapshot()));
            from = whole.said.len();
        }
        whole.take(frame);
        if let Some(twin) = &mut twin {
            twin.take(frame);
            let differ = whole.said[from..].iter().zip(&twin.said).find(|(a, b)| a != b);
            assert_eq!(differ, None, "frame {at}");
            assert_eq!(whole.said.len() - from, twin.said.len(), "frame {at}");
            from = whole.said.len();
            twin.said.clear();
        }
    }
    assert!(whole.monitor.model().own.is_some(), "{:?}", whole.monitor.model().state);
}

#[test]
fn external_fit_equals_monitor_fit() {
    let config = configuration("nmc811-graphite");
    let (mut alone, mut helped, mut fits) = (Live::new(&config), Live::new(&config), 0);
    let frames = vehicle(&true_model(&config), &config, TRUE_AH, &DEEP, 2);
    for frame in with_rests(&config, frames, FULL_V) {
        alone.take(&frame);
        helped.take(&frame);
        if let Some(task) = helped.monitor.take_model_fit() {
            fits += 1;
            let findings = task.run();
            helped.monitor.give_model_fit(task, findings);
        }
    }
    assert!(fits >= 2, "{fits} fits started at rest");
    let differ = alone.said.iter().zip(&helped.said).find(|(a, b)| a != b);
    assert_eq!((differ, alone.said.len()), (None, helped.said.len()));
    assert!(alone.monitor.model().own.is_some());
}

#[test]
fn findings_apply_only_to_their_task() {
    let config = configuration("nmc811-graphite");
    let frames = with_rests(&config, vehicle(&true_model(&config), &config, TRUE_AH, &DEEP, 2), FULL_V);
    let unfit_with = |is_first: bool| {
        let (mut live, mut first) = (Live::new(&config), None);
        for frame in &frames {
            live.take(frame);
            if let Some(task) = live.monitor.take_model_fit() {
                let findings = FitFindings { chemistry: Some(Chemistry::LfpGraphite), ..task.run() };
                let given = first.get_or_insert((task.clone(), findings.clone())).clone();
                let given = if is_first { given } else { (task, findings) };
                live.monitor.give_model_fit(given.0, given.1);
            }
        }
        live.monitor.model().state == ModelState::Unfit
    };
    assert!(unfit_with(false), "findings of the current task must be used");
    assert!(!unfit_with(true), "findings of an earlier task must be ignored");
}

#[test]
fn wrong_label_chemistry_is_found_in_one_cycle() {
    let truth = configuration("nmc811-graphite");
    let model = true_model(&truth);
    for (wrong, right) in [("lfp-graphite", "nmc"), ("lco-graphite", "n")] {
        let config = configuration(wrong);
        let mut live = Live::new(&config);
        vehicle(&model, &truth, TRUE_AH, &DEEP, 1).iter().for_each(|frame| live.take(frame));
        live.give(Record::unknown_gap(Timestamp::from_secs(4e9)));
        let view = live.monitor.model();
        assert_eq!(view.state, ModelState::Unfit, "{wrong}");
        let better = view.chemistry.map(Chemistry::name).unwrap_or_default();
        assert!(better.starts_with(right), "{wrong}: {better}");
        assert!(view.own.is_none(), "the label's model must be kept");
    }
}

#[test]
fn corrected_label_keeps_rows_and_discards_model() {
    let wrong = configuration("lfp-graphite");
    let right = configuration("nmc811-graphite");
    let mut live = Live::new(&wrong);
    vehicle(&true_model(&right), &right, TRUE_AH, &DEEP, 2).iter().for_each(|frame| live.take(frame));
    let rows = live.monitor.model().notebook.map_or(0, |notebook| notebook.rows().len());
    assert!(rows > 20, "{rows} rows");
    let mut corrected = Live::restored(&right, live.monitor.snapshot());
    corrected.give(Record::unknown_gap(Timestamp::from_secs(4e9)));
    let view = corrected.monitor.model();
    assert!(view.notebook.map_or(0, |notebook| notebook.rows().len()) >= rows);
    assert!(matches!(view.state, ModelState::Learning | ModelState::Learned), "{:?}", view.state);
}

/// The prior of ten equal vehicles whose resistance is twice that of the label's model.
fn resistive_prior(label: &Label) -> FleetPrior {
    let of_label = label.prior().unwrap();
    let (modes_v, rest_v) = of_label.curve.modes_v();
    let array = |values: &[f64]| std::array::from_fn(|s| values[s]);
    let own = OwnModel {
        curve_v: array(&of_label.curve.mean_v),
        modes_v: modes_v.each_ref().map(|mode_v| array(mode_v)),
        rest_v: array(&rest_v),
        factors: ResistanceFactors { ln: [[2.0_f64.ln(); 9]; 4], by_temperature: [0.0; 4] },
        drop_std: [0.05; 4],
        cold_sag_v: ScalarGaussian::from_std(0.015, 0.015),
        capacity: ScalarGaussian::from_std(4.5, 0.05),
        residual_v: 0.005,
    };
    FleetPrior::new(label, &vec![own; 10]).unwrap()
}

#[test]
fn prior_given_later_replaces_stored_resistance() {
    let config = configuration("nmc811-graphite");
    let mut live = Live::new(&config);
    vehicle(&config.model, &config, TRUE_AH, &[(0.5, 0.85)], 1).iter().for_each(|frame| live.take(frame));
    assert!(live.monitor.model().own.is_none(), "too little data for a model");
    let stored = live.monitor.snapshot();
    let last = live.monitor.latest().next().flatten().unwrap();
    let fleet = resistive_prior(&config.label.unwrap());
    let prior = configuration_from("nmc811-graphite", "", Some(&toml::to_string(&fleet).unwrap()));
    let [kept, changed] = [&config, &prior].map(|config| {
        let mut live = Live::new(config);
        live.monitor.restore(stored.clone(), Downtime::Seconds(10.0)).unwrap();
        let frames = vehicle(&config.model, config, TRUE_AH, &[(0.84, 0.85)], 1);
        let first = frames[0].0;
        let later = frames
            .iter()
            .take(40)
            .map(|(time, bus, frame)| (last.time.plus_secs(10.0 + time.since(first)), *bus, *frame));
        later.for_each(|frame| live.take(&frame));
        live.monitor.latest().next().flatten().unwrap()
    });
    assert!((kept.capacity_ah - last.capacity_ah).abs() < 0.05, "{kept:?}");
    // The stored resistance refers to the label's model, so it is discarded. The prior's capacity is more certain than
    // the stored capacity, so it replaces the stored capacity.
    assert!((changed.resistance_ratio - 1.0).abs() < 0.01, "relative to the prior: {changed:?}");
    assert!(changed.resistance_ratio_std > kept.resistance_ratio_std, "{kept:?} {changed:?}");
    assert!((changed.capacity_ah - fleet.mean.capacity.mean).abs() < 0.05, "{changed:?}");
    assert!((changed.soc - kept.soc).abs() < 0.05 && changed.soc_std < 0.1, "the SOC is kept: {kept:?} {changed:?}");
}

#[test]
fn vehicle_starts_from_what_a_fleet_has_learned() {
    let config = configuration("nmc811-graphite");
    let truth = true_model(&config);
    let swings = [DEEP[0], PARTIAL[0], PARTIAL[1]];
    let learned = [4.5, 4.6, 4.8, 4.9].map(|capacity_ah| {
        let mut live = Live::new(&config);
        vehicle(&truth, &config, capacity_ah, &swings, 3).iter().for_each(|frame| live.take(frame));
        live.give(Record::unknown_gap(Timestamp::from_secs(4e9)));
        live.monitor.model().own.expect("a learned model").clone()
    });
    let label = config.label.unwrap();
    let fleet = FleetPrior::new(&label, &learned).unwrap();
    fleet.check().unwrap();
    let capacity = fleet.mean.capacity;
    assert!((capacity.mean - TRUE_AH).abs() < 0.15 && (0.17..0.5).contains(&capacity.std()), "{capacity:?}");
    let model = fleet.cell_model().unwrap();
    let ohm = |model: &CellModel| model.settled_ohm(&model.grid_position(0.5, 25.0));
    assert!((ohm(&model) / ohm(&truth) - 1.0).abs() < 0.1 * ohm(&config.model) / ohm(&truth));

    let text = toml::to_string(&fleet).unwrap();
    let prior = configuration_from("nmc811-graphite", "", Some(&text));
    assert_eq!(prior.fleet.as_ref(), Some(&fleet));
    assert_eq!(prior.model.capacity_ah, model.capacity_ah);
    let frames = vehicle(&truth, &config, TRUE_AH, &[(0.25, 0.85)], 1);
    let errors = [&config, &prior].map(|config| {
        let mut live = Live::new(config);
        frames.iter().for_each(|frame| live.take(frame));
        let last = live.monitor.latest().next().flatten().unwrap();
        // The cycle ends at the upper end of its SOC range.
        (last.soc - 0.85, last.soc_std)
    });
    let [(_, label_std), (off, std)] = errors;
    assert!(std < 0.8 * label_std && off.abs() < 1.96 * std, "{errors:?}");
    // The vehicle's own fit also starts from the fleet's prior.
    let own = [&config, &prior].map(|config| {
        let mut live = Live::new(config);
        vehicle(&truth, config, TRUE_AH, &swings, 3).iter().for_each(|frame| live.take(frame));
        live.give(Record::unknown_gap(Timestamp::from_secs(4e9)));
        live.monitor.model().own.expect("a learned model").capacity
    });
    assert!((own[1].mean - TRUE_AH).abs() < 1.96 * own[1].std(), "{own:?}");
    assert!(own[1].std() < own[0].std(), "{own:?}");
}
