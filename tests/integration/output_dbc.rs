//! Checks the written DBC: `cantools` must load it in strict mode, and every sent frame must decode to the original
//! values within half a step of each signal.

use std::collections::{BTreeSet, HashMap};
use std::path::Path;

use crate::support::oracle::{ask, hex, python, values};
use packwatch::alarm::Rule;
use packwatch::can::dbc::{Database, Repetition};
use packwatch::can::e2e::{Profile, Protection};
use packwatch::can::encode::{
    AlarmFields, Command, CommandFields, CommandPlan, CommandRefusal, DigestFields, E2eSetting, HealthFields,
    LayoutBase, LayoutSettings, MessageSettings, OutputPlan, ReplyFields, RuleState, SendCounters, StatusFields,
    TableChecksum, ThresholdFields, layout,
};
use packwatch::can::secoc::{self, Authentication};
use packwatch::can::{CanId, Frame, FrameKind};
use packwatch::quantity::catalogue::{Estimate, PackValues, Part, Quantity as Q};
use packwatch::quantity::{CellIndex, Mode};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// Energy, time and power in the health frame: page, signal, quantity, part, largest value.
const OUTLOOK: [(usize, &str, Q, Part, f64); 18] = [
    (5, "RemainingEnergy", Q::RemainingEnergy, Part::Mean, 1_048_574.0),
    (5, "RemainingEnergyStd", Q::RemainingEnergy, Part::Std, 1_048_574.0),
    (6, "EnergyToFull", Q::EnergyToFull, Part::Mean, 1_048_574.0),
    (6, "EnergyToFullStd", Q::EnergyToFull, Part::Std, 1_048_574.0),
    (7, "TimeToEmpty", Q::TimeToEmpty, Part::Mean, 163_820.0),
    (7, "TimeToFull", Q::TimeToFull, Part::Mean, 163_820.0),
    (7, "TimeToTarget", Q::TimeToTarget, Part::Mean, 163_820.0),
    (8, "TimeToEmptyStd", Q::TimeToEmpty, Part::Std, 163_820.0),
    (8, "TimeToFullStd", Q::TimeToFull, Part::Std, 163_820.0),
    (8, "TimeToTargetStd", Q::TimeToTarget, Part::Std, 163_820.0),
    (9, "DischargePower10s", Q::DischargePower10s, Part::Mean, 655_340.0),
    (9, "DischargePower10sStd", Q::DischargePower10s, Part::Std, 655_340.0),
    (10, "ChargePower10s", Q::ChargePower10s, Part::Mean, 655_340.0),
    (10, "ChargePower10sStd", Q::ChargePower10s, Part::Std, 655_340.0),
    (11, "DischargePower2s", Q::DischargePower2s, Part::Mean, 655_340.0),
    (11, "DischargePower30s", Q::DischargePower30s, Part::Mean, 655_340.0),
    (12, "ChargePower2s", Q::ChargePower2s, Part::Mean, 655_340.0),
    (12, "ChargePower30s", Q::ChargePower30s, Part::Mean, 655_340.0),
];
const HEALTH_PAGES: [&str; 13] = [
    "capacity",
    "recharge",
    "usable",
    "life",
    "losses",
    "energy",
    "energy_to_full",
    "time",
    "time_std",
    "discharge_power",
    "charge_power",
    "discharge_powers",
    "charge_powers",
];

const FRAMES: usize = 40;

/// Name, factor from the internal unit to the frame's unit, and largest tested value, in the order of the rule numbers.
const RULES: [(&str, f64, f64); 18] = [
    ("CapacityLow", 1.0, 5.0),
    ("UsableCapacityLow", 1.0, 5.0),
    ("RechargePeriodLow", 1.0, 50_000.0),
    ("InputMissing", 1.0, 800.0),
    ("InputImplausible", 100.0, 1.0),
    ("EstimateUntrusted", 1.0, 80.0),
    ("ResistanceHigh", 100.0, 8.0),
    ("SocLow", 100.0, 1.0),
    ("TemperatureHigh", 1.0, 150.0),
    ("CellImbalance", 100.0, 1.0),
    ("RemainingLifeLow", 1.0, 5000.0),
    ("BmsDisagrees", 100.0, 1.0),
    ("StoreFailed", 1.0, 4094.0),
    ("BusFault", 1.0, 4094.0),
    ("CellLeak", 100.0, 0.4),
    ("ConnectionResistance", 100.0, 8.0),
    ("ChannelFaulty", 1.0, 1.0),
    ("ThermalEvent", 1.0, 3.0),
];

/// Rules on page `rules` of the digest; the other rules are on page `rules_2`.
const RULES_ON_PAGE_1: usize = 14;

const REFUSALS: [CommandRefusal; 8] = [
    CommandRefusal::FirstFrame,
    CommandRefusal::WrongChecksum,
    CommandRefusal::RepeatedCounter,
    CommandRefusal::WrongCounter,
    CommandRefusal::NoMeaning,
    CommandRefusal::NotAuthentic,
    CommandRefusal::OldFreshness,
    CommandRefusal::RepeatNeeded,
];

#[derive(Debug, Clone, Copy)]
struct Case {
    fd: bool,
    profile: Option<Profile>,
    extended: bool,
    rated_capacity_ah: f64,
}

impl Case {
    fn all() -> Vec<Self> {
        let mut cases = Vec::new();
        for fd in [false, true] {
            for profile in [None, Some(Profile::P01A), Some(Profile::P01C), Some(Profile::P05)] {
                for extended in [false, true] {
                    for rated_capacity_ah in [2.6, 280.0] {
                        // Profile 5 needs CAN FD.
                        if fd || profile != Some(Profile::P05) {
                            cases.push(Self { fd, profile, extended, rated_capacity_ah });
                        }
                    }
                }
            }
        }
        cases
    }

    fn message(&self, number: u16) -> MessageSettings {
        let id = if self.extended {
            CanId::Extended(0x18FF_5000 + u32::from(number))
        } else {
            CanId::Standard(0x200 + number)
        };
        let e2e = self
            .profile
            .map_or(E2eSetting::Off, |profile| E2eSetting::On(Protection { profile, data_id: 0x0A50 + number }));
        MessageSettings { id: Some(id), fd: Some(self.fd), brs: Some(self.fd), period_ms: Some(250), e2e, secoc: None }
    }

    fn layout(&self) -> Database {
        let settings = LayoutSettings {
            status: self.message(1),
            health: self.message(2),
            alarm: self.message(3),
            command: Some(self.message(4)),
            digest: self.message(5),
            reply: self.message(6),
            freshness: MessageSettings::default(),
        };
        layout(LayoutBase::BuiltIn { rated_capacity_ah: self.rated_capacity_ah }, &settings).unwrap()
    }
}

/// Values that a receiver must read: name, value in the DBC's unit, and tolerance (half a step).
type Wanted = Vec<(String, f64, f64)>;

struct Maker {
    random: ChaCha8Rng,
    plan: OutputPlan,
    counters: SendCounters,
    rated_capacity_ah: f64,
    database: Database,
}

impl Maker {
    fn below(&mut self, limit: f64) -> f64 {
        f64::from(self.random.next_u32()) / f64::from(u32::MAX) * limit
    }

    fn one_of(&mut self, count: u32) -> u32 {
        self.random.next_u32() % count
    }

    /// Half a step of a signal in the layout, so that the test checks the promised resolution.
    fn half_step(&self, name: &str) -> f64 {
        self.database.signal(name).unwrap().1.layout.factor / 2.0
    }

    /// A random threshold of a rule, and the value that a receiver must read.
    fn threshold(&mut self, number: usize) -> (ThresholdFields, f64) {
        let (_, scale, largest) = RULES[number - 1];
        let (threshold, severity) = (self.below(largest), 1 + self.one_of(3));
        let (rule, severity) = (u8::try_from(number).unwrap(), u8::try_from(severity).unwrap());
        (ThresholdFields { rule, severity, threshold }, scale * threshold)
    }

    fn wanted(&self, message: &str, pairs: &[(&str, f64)]) -> Wanted {
        let one = |(name, value): &(&str, f64)| {
            ((*name).to_owned(), *value, self.half_step(&format!("PACKWATCH_{message}.{name}")))
        };
        pairs.iter().map(one).collect()
    }

    fn status(&mut self) -> (Frame, Wanted) {
        let (soc, soc_std, mode) = (self.below(1.0), self.below(0.25), self.one_of(4));
        let (validity, severity, alarms) = (self.one_of(4), self.one_of(4), self.one_of(62));
        let (cell, unknown) = (self.one_of(1024), self.one_of(3));
        let fields = StatusFields {
            soc: Some(soc),
            soc_std: Some(soc_std),
            mode: Some([Mode::Unknown, Mode::Charge, Mode::Rest, Mode::Discharge][mode as usize]),
            validity: u8::try_from(validity).unwrap(),
            highest_severity: u8::try_from(severity).ok(),
            active_alarms: u16::try_from(alarms).ok(),
            limiting_cell: u16::try_from(cell).ok().map(CellIndex),
            unknown_rules: u8::try_from(unknown).ok(),
        };
        let wanted = self.wanted(
            "Status",
            &[
                ("Soc", 100.0 * soc),
                ("SocStd", 100.0 * soc_std),
                ("Mode", f64::from(mode)),
                ("Validity", f64::from(validity)),
                ("HighestSeverity", f64::from(severity)),
                ("ActiveAlarms", f64::from(alarms)),
                ("LimitingCell", f64::from(cell)),
                ("UnknownRules", f64::from(unknown)),
            ],
        );
        (self.plan.status(&fields, &mut self.counters), wanted)
    }

    fn health(&mut self, page: usize) -> (Frame, Wanted) {
        let largest_ah = 2.0 * self.rated_capacity_ah;
        let (capacity, std, soh) = (self.below(largest_ah), self.below(largest_ah / 4.0), self.below(2.0));
        let (period, normalised) = (self.below(60_000.0), self.below(60_000.0));
        let (usable, usable_std, ratio) = (self.below(largest_ah), self.below(largest_ah / 4.0), self.below(4.0));
        let (cycles, cycles_low, days) = (self.below(60_000.0), self.below(60_000.0), self.below(8_000.0));
        let losses = [(); 3].map(|()| [self.below(1.0), self.below(0.3)]);
        let values = OUTLOOK.map(|(.., limit)| self.below(limit));
        let mut outlook = PackValues::default();
        for (n, (_, _, quantity, _, _)) in OUTLOOK.into_iter().enumerate().filter(|(_, it)| it.3 == Part::Mean) {
            let std = OUTLOOK.iter().position(|it| (it.2, it.3) == (quantity, Part::Std)).map(|place| values[place]);
            outlook.set(quantity, Some(Estimate { mean: values[n], std }));
        }
        let fields = HealthFields {
            capacity_ah: Some(capacity),
            capacity_std_ah: Some(std),
            soh: Some(soh),
            recharge_period_s: Some(period),
            normalized_recharge_period_s: Some(normalised),
            usable_capacity_ah: Some(usable),
            usable_capacity_std_ah: Some(usable_std),
            resistance_ratio: Some(ratio),
            remaining_cycles: Some(cycles),
            remaining_cycles_low: Some(cycles_low),
            remaining_days: Some(days),
            lli: losses[0].map(Some),
            lam_ne: losses[1].map(Some),
            lam_pe: losses[2].map(Some),
            model_state: Some(2),
            outlook,
        };
        let mut wanted = match page {
            0 => self.wanted("Health", &[("Capacity", capacity), ("CapacityStd", std), ("Soh", 100.0 * soh)]),
            1 => self.wanted(
                "Health",
                &[("RechargePeriod", period), ("NormalizedRechargePeriod", normalised), ("ModelState", 2.0)],
            ),
            2 => self.wanted(
                "Health",
                &[("UsableCapacity", usable), ("UsableCapacityStd", usable_std), ("ResistanceRatio", 100.0 * ratio)],
            ),
            4 => self.wanted(
                "Health",
                &[
                    ("Lli", 100.0 * losses[0][0]),
                    ("LliStd", 100.0 * losses[0][1]),
                    ("LamNe", 100.0 * losses[1][0]),
                    ("LamNeStd", 100.0 * losses[1][1]),
                    ("LamPe", 100.0 * losses[2][0]),
                    ("LamPeStd", 100.0 * losses[2][1]),
                ],
            ),
            5.. => {
                let on_page = OUTLOOK.iter().zip(values).filter(|(it, _)| it.0 == page);
                self.wanted("Health", &on_page.map(|(it, value)| (it.1, value)).collect::<Vec<_>>())
            }
            _ => self.wanted(
                "Health",
                &[("RemainingCycles", cycles), ("RemainingCyclesLow", cycles_low), ("RemainingDays", days)],
            ),
        };
        wanted.push(("Page".to_owned(), f64::from(u8::try_from(page).unwrap()), 0.0));
        (self.plan.health(page, &fields, &mut self.counters), wanted)
    }

    fn alarm(&mut self, number: usize) -> (Frame, Wanted) {
        let (name, scale, largest) = RULES[number - 1];
        let largest = if name.ends_with("CapacityLow") { 2.0 * self.rated_capacity_ah } else { largest };
        let (value, threshold) = (self.below(largest), self.below(largest));
        let (state, severity, cell) = (self.one_of(7), 1 + self.one_of(3), self.one_of(1024));
        let (test, acknowledged) = (self.one_of(2), self.one_of(2));
        let rule = u8::try_from(number).unwrap();
        let fields = AlarmFields {
            rule,
            state: u8::try_from(state).ok(),
            severity: u8::try_from(severity).ok(),
            test: test == 1,
            acknowledged: acknowledged == 1,
            cell: u16::try_from(cell).ok().map(CellIndex),
            value: Some(value),
            threshold: Some(threshold),
        };
        let wanted = self.wanted(
            "Alarm",
            &[
                ("Rule", f64::from(rule)),
                ("State", f64::from(state)),
                ("Severity", f64::from(severity)),
                ("Test", f64::from(test)),
                ("Acknowledged", f64::from(acknowledged)),
                ("Cell", f64::from(cell)),
                (&format!("Value_{name}"), scale * value),
                (&format!("Threshold_{name}"), scale * threshold),
            ],
        );
        (self.plan.alarm(&fields, &mut self.counters), wanted)
    }

    fn digest(&mut self, page: usize, threshold_rule: usize) -> (Frame, Wanted) {
        const STATES: [RuleState; 6] = [
            RuleState::None,
            RuleState::Info,
            RuleState::Warning,
            RuleState::Severe,
            RuleState::Unknown,
            RuleState::NotWatched,
        ];
        let (raised, worst, pass_time_s) = (self.one_of(4095), self.one_of(4), self.below(204.0));
        let codes = RULES.map(|_| self.one_of(6));
        let mut checksum = TableChecksum::default();
        checksum.add(9, 2, None, u8::try_from(self.one_of(7)).unwrap(), self.one_of(2) == 1);
        let (threshold, threshold_read) = self.threshold(threshold_rule);
        let fields = DigestFields {
            raised: raised as usize,
            worst: u8::try_from(worst).unwrap(),
            checksum,
            pass_time_s,
            rules: codes.map(|code| STATES[code as usize]),
            threshold: Some(threshold),
        };
        let mut wanted = match page {
            0 => self.wanted(
                "Digest",
                &[
                    ("Raised", f64::from(raised)),
                    ("Worst", f64::from(worst)),
                    ("TableChecksum", f64::from(checksum.value())),
                    ("PassTime", pass_time_s),
                ],
            ),
            2 => {
                let (rule, severity) = (f64::from(threshold.rule), f64::from(threshold.severity));
                let mut wanted = self.wanted("Digest", &[("ThresholdRule", rule), ("ThresholdSeverity", severity)]);
                // The threshold is not rounded, so its only error is the resolution of a 32-bit float.
                wanted.push(("Threshold".to_owned(), threshold_read, threshold_read * f64::from(f32::EPSILON)));
                wanted
            }
            _ => {
                let rules = if page == 1 { 0..RULES_ON_PAGE_1 } else { RULES_ON_PAGE_1..RULES.len() };
                let named: Vec<_> =
                    rules.map(|rule| (format!("Rule_{}", RULES[rule].0), f64::from(codes[rule]))).collect();
                let pairs: Vec<_> = named.iter().map(|(name, code)| (name.as_str(), *code)).collect();
                self.wanted("Digest", &pairs)
            }
        };
        wanted.push(("Page".to_owned(), f64::from(u8::try_from(page).unwrap()), 0.0));
        (self.plan.digest(page, &fields, &mut self.counters).unwrap(), wanted)
    }

    /// The reply to an executed, a rejected or an unreadable command, in turn.
    fn reply(&mut self, turn: usize) -> (Frame, Wanted) {
        const KINDS: [Command; 3] = [Command::Acknowledge, Command::Clear, Command::PackReplaced];
        let (kind, rule) = (turn % KINDS.len(), 1 + turn % RULES.len());
        let (severity, cell, counter) = (1 + self.one_of(3), self.one_of(1024), self.one_of(256));
        let (changed, refused) = (1 + self.one_of(70), self.one_of(20));
        let refusal = REFUSALS[turn % REFUSALS.len()];
        let is_executed = turn.is_multiple_of(2);
        let is_read = is_executed || turn.is_multiple_of(3);
        let command = CommandFields {
            command: KINDS[kind],
            rule: u8::try_from(rule).ok(),
            severity: u8::try_from(severity).ok(),
            cell: u16::try_from(cell).ok().map(CellIndex),
        };
        let fields = ReplyFields {
            outcome: if is_executed { Ok((changed, refused)) } else { Err(refusal) },
            command: is_read.then_some(command),
            counter_expected: u8::try_from(counter).ok(),
        };
        let reason = match (is_executed, refused) {
            (false, _) => f64::from(refusal as u8),
            (true, 0) => 0.0,
            (true, _) => 6.0,
        };
        let read = |value: u32, code: f64| if is_read { f64::from(value) } else { code };
        let counted = |count: u32, most: u32, code: f64| if is_executed { f64::from(count.min(most)) } else { code };
        let wanted = self.wanted(
            "Reply",
            &[
                ("Result", if is_executed { 1.0 } else { 2.0 }),
                ("Reason", reason),
                ("Command", read(u32::try_from(kind).unwrap() + 1, 15.0)),
                ("Rule", read(u32::try_from(rule).unwrap(), 31.0)),
                ("Severity", read(severity, 0.0)),
                ("Cell", read(cell, 2047.0)),
                ("CounterExpected", f64::from(counter)),
                ("Changed", counted(changed, 62, 63.0)),
                ("Refused", counted(refused, 14, 15.0)),
            ],
        );
        (self.plan.reply(&fields, &mut self.counters).unwrap(), wanted)
    }
}

/// Checks that a receiver with the DBC reads the same protection header as packwatch itself.
fn check_header(case: Case, number: u16, frame: &Frame, read: &HashMap<String, f64>, expected: &mut [u8; 7]) {
    let Some(profile) = case.profile else {
        assert!(!read.contains_key("E2eCrc") && frame.data()[..2] == [0, 0], "{case:?}");
        return;
    };
    let protection = Protection { profile, data_id: 0x0A50 + number };
    let counter = &mut expected[usize::from(number)];
    assert_eq!(protection.verified_counter(frame.data()), Some(*counter), "{case:?}");
    assert_eq!(read["E2eCounter"], f64::from(*counter), "{case:?}");
    *counter = profile.next_counter(*counter);
    if profile == Profile::P01C {
        assert_eq!(read["E2eDataIdNibble"], 10.0, "the low nibble of 0x0A");
    }
}

/// `Message.Signal` of every sent signal.
fn sent_signals(database: &Database) -> BTreeSet<String> {
    let sent = database.messages.iter().filter(|message| message.name != "PACKWATCH_Command");
    let signals = |message: &packwatch::can::dbc::Message| -> Vec<String> {
        message.signals.iter().map(|signal| format!("{}.{}", message.name, signal.name)).collect()
    };
    sent.flat_map(signals).collect()
}

#[test]
fn written_dbc_decodes_frames_within_half_step() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("written.dbc");
    let (mut frames, mut compared) = (0, 0);
    let cases = Case::all();
    for (seed, case) in (0..).zip(&cases) {
        let database = case.layout();
        std::fs::write(&path, database.to_dbc_bytes()).unwrap();
        assert_eq!(Database::parse_bytes(&std::fs::read(&path).unwrap()).unwrap(), database);
        let mut maker = Maker {
            random: ChaCha8Rng::seed_from_u64(seed),
            plan: OutputPlan::new(&database).unwrap(),
            counters: SendCounters::default(),
            rated_capacity_ah: case.rated_capacity_ah,
            database,
        };
        let mut made: Vec<(u16, &str, Frame, Wanted)> = Vec::new();
        for turn in 0..FRAMES {
            let (frame, wanted) = maker.status();
            made.push((1, "PACKWATCH_Status", frame, wanted));
            let (frame, wanted) = maker.health(turn % maker.plan.health_pages());
            made.push((2, "PACKWATCH_Health", frame, wanted));
            let (frame, wanted) = maker.alarm(turn % RULES.len() + 1);
            made.push((3, "PACKWATCH_Alarm", frame, wanted));
            for page in 0..maker.plan.digest_pages() {
                let (frame, wanted) = maker.digest(page, turn % RULES.len() + 1);
                made.push((5, "PACKWATCH_Digest", frame, wanted));
            }
            let (frame, wanted) = maker.reply(turn);
            made.push((6, "PACKWATCH_Reply", frame, wanted));
        }
        let lines: Vec<_> = made.iter().map(|(_, name, frame, _)| format!("{name} {}", hex(frame.data()))).collect();
        let answers = ask(&python, &path, &["decode", "strict"], &lines);
        let mut expected = [0; 7];
        let mut decoded = BTreeSet::new();
        for (((number, message, frame, wanted), line), answer) in made.iter().zip(&lines).zip(&answers) {
            let read = values(line, answer);
            let kind = if case.fd { FrameKind::Fd { brs: true, esi: false } } else { FrameKind::Classic };
            assert_eq!((frame.kind(), frame.id()), (kind, case.message(*number).id.unwrap()));
            for (name, value, half_step) in wanted {
                let off = (read[name] - value).abs();
                assert!(off <= half_step + 1e-9, "{case:?} {name}: read {}, sent {value}", read[name]);
            }
            let header =
                if case.profile.is_some() { read.keys().filter(|name| name.starts_with("E2e")).count() } else { 0 };
            assert_eq!(
                read.len(),
                wanted.len() + header,
                "{case:?}: the receiver reads other signals than expected: {read:?}"
            );
            check_header(*case, *number, frame, &read, &mut expected);
            decoded.extend(read.into_keys().map(|signal| format!("{message}.{signal}")));
            frames += 1;
            compared += wanted.len() + header;
        }
        assert_eq!(decoded, sent_signals(&maker.database), "{case:?}: every sent signal must be compared");
    }
    assert_eq!(cases.len(), 28);
    eprintln!("{} configurations, {frames} frames, {compared} values compared", cases.len());
}

#[test]
fn dbc_describes_configured_frames() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("written.dbc");
    for case in Case::all() {
        std::fs::write(&path, case.layout().to_dbc_bytes()).unwrap();
        let profile = case.profile.map_or("-", |profile| profile.name());
        let wanted = (1..).zip(["Status", "Health", "Alarm", "Command", "Digest", "Reply"]).map(|(number, name)| {
            let id = case.message(number).id.unwrap().raw();
            let (extended, fd) = (u8::from(case.extended), u8::from(case.fd));
            let length = if case.profile == Some(Profile::P05) { 12 } else { 8 };
            let data_id = case.profile.map_or("-".to_owned(), |_| (0x0A50 + number).to_string());
            format!("PACKWATCH_{name} {id} {extended} {fd} {fd} {length} 250 {profile} {data_id}")
        });
        assert_eq!(ask(&python, &path, &["about", "strict"], &[]), wanted.collect::<Vec<_>>(), "{case:?}");
    }
}

/// Converts `capacity_low` to the DBC's form `CapacityLow`.
fn camel_case(name: &str) -> String {
    let capital = |word: &str| word[..1].to_uppercase() + &word[1..];
    name.split('_').map(capital).collect()
}

#[test]
fn whole_second_threshold_is_sent_exactly() {
    let layout = Case::all()[0].layout();
    for name in ["PACKWATCH_Alarm.Threshold_StoreFailed", "PACKWATCH_Alarm.Threshold_BusFault"] {
        let (_, signal) = layout.signal(name).unwrap();
        assert_eq!((signal.layout.factor, signal.layout.offset), (1.0, 0.0), "{name}: the resolution must be 1 s");
    }
}

#[test]
fn tested_rules_are_complete_and_ordered() {
    assert_eq!(RULES.map(|(name, ..)| name.to_owned()), Rule::ALL.map(|rule| camel_case(rule.name())));
}

/// Word for a refusal, as in the value table of `Reason`.
const fn reason_word(refusal: CommandRefusal) -> &'static str {
    match refusal {
        CommandRefusal::FirstFrame => "first frame",
        CommandRefusal::WrongChecksum => "wrong checksum",
        CommandRefusal::RepeatedCounter => "repeated counter",
        CommandRefusal::WrongCounter => "wrong counter",
        CommandRefusal::NoMeaning => "no meaning",
        CommandRefusal::NotAuthentic => "not authentic",
        CommandRefusal::OldFreshness => "old freshness",
        CommandRefusal::RepeatNeeded => "repeat needed",
    }
}

#[test]
fn refusal_codes_match_dbc_value_table() {
    let database = Case::all()[0].layout();
    let plan = OutputPlan::new(&database).unwrap();
    let reason = &database.signal("PACKWATCH_Reply.Reason").unwrap().1;
    let mut table = vec![(0, "none"), (6, "not healthy"), (7, "nothing to do"), (15, "not available")];
    for refusal in REFUSALS {
        let fields = ReplyFields { outcome: Err(refusal), command: None, counter_expected: None };
        let frame = plan.reply(&fields, &mut SendCounters::default()).unwrap();
        let code = reason.layout.plan().unwrap().raw(frame.data()).unwrap();
        assert_eq!(code, u64::from(refusal as u8), "{refusal:?}");
        table.push((i64::try_from(code).unwrap(), reason_word(refusal)));
    }
    table.sort_unstable();
    assert_eq!(words(&database, "PACKWATCH_Reply.Reason"), table);
}

fn words<'d>(database: &'d Database, signal: &str) -> Vec<(i64, &'d str)> {
    let table = &database.signal(signal).unwrap().1.values;
    table.iter().map(|(code, word)| (*code, word.as_str())).collect()
}

#[test]
fn rule_value_tables_match_rule_numbers() {
    let text = include_str!("../../config/packwatch.dbc");
    let dbc = Database::parse(text).unwrap();
    let rules = Rule::ALL.map(|rule| (i64::from(rule as u8), camel_case(rule.name())));
    for message in ["Alarm.Rule", "Command.Rule", "Reply.Rule", "Digest.ThresholdRule"] {
        let signal = &format!("PACKWATCH_{message}");
        let table = &dbc.signal(signal).unwrap().1.values;
        assert_eq!(table[..rules.len()], rules, "{signal}");
        assert_eq!(table.len(), rules.len() + 1, "{signal} must have every rule, and a code for none or all");
    }
}

const CONTRACT: &str = include_str!("../../docs/src/ecu/contract.md");

/// Messages in the table on the contract page, without their prefix.
fn contract_rows() -> Vec<&'static str> {
    contract_table().map(|cells| cells[1].trim_matches('`').trim_start_matches("PACKWATCH_")).collect()
}

/// Identifier, period, repetition and timeout of each message.
fn contract_cells() -> impl Iterator<Item = [String; 4]> {
    contract_table().map(|cells| [2, 3, 5, 6].map(|at| cells[at].to_owned()))
}

fn contract_table() -> impl Iterator<Item = Vec<&'static str>> {
    let rows = CONTRACT.lines().filter(|line| line.starts_with("| `PACKWATCH_"));
    rows.map(|line| line.split('|').map(str::trim).collect())
}

/// Compares with the manual's page `docs/src/ecu/contract.md`, sections "Messages" and "Budget".
#[test]
fn dbc_timing_matches_contract_page() {
    let base = LayoutBase::BuiltIn { rated_capacity_ah: 2.6 };
    // Replies are sent if commands are accepted. Freshness values are sent if commands are authenticated.
    let secoc = |profile, data_id| Some(Authentication { profile, data_id });
    let command = MessageSettings { secoc: secoc(secoc::Profile::P1, 1), ..MessageSettings::default() };
    let freshness = MessageSettings { secoc: secoc(secoc::Profile::Announcement, 2), ..MessageSettings::default() };
    let settings = LayoutSettings { command: Some(command), freshness, ..LayoutSettings::default() };
    let database = Database::parse(&layout(base, &settings).unwrap().to_dbc()).unwrap();
    let stated = |name: &str| {
        let message = database.message(&format!("PACKWATCH_{name}")).unwrap();
        let Repetition { count, period_ms, delay_ms } = message.repetition;
        (message.cycle_time_ms, count, period_ms, delay_ms)
    };
    assert_eq!(stated("Status"), (Some(100), None, None, None));
    assert_eq!(stated("Health"), (Some(1000), None, None, None));
    assert_eq!(stated("Alarm"), (Some(1000), Some(3), Some(100), Some(10)), "3 times, 100 ms apart, 100 per second");
    assert_eq!(stated("Digest"), (Some(1000), None, None, None));
    assert_eq!(stated("Reply"), (None, None, None, Some(100)), "10 a second");
    assert_eq!(stated("Freshness"), (Some(1000), None, None, None));
    assert_eq!(stated("Command"), (None, None, None, None), "the sender's task");
    assert_eq!(contract_rows(), ["Status", "Health", "Alarm", "Command", "Digest", "Reply", "Freshness"]);
    for (name, [identifier, period, repetition, timeout]) in contract_rows().iter().zip(contract_cells()) {
        let message = database.message(&format!("PACKWATCH_{name}")).unwrap();
        let id = u32::from_str_radix(identifier.trim_start_matches("0x"), 16).unwrap();
        assert_eq!(message.id, CanId::standard(id).unwrap(), "{name}");
        let first_ms = |text: &str| -> Option<u32> {
            let words: Vec<&str> = text.split([' ', ',']).collect();
            words.windows(2).find(|pair| pair[1] == "ms").and_then(|pair| pair[0].parse().ok())
        };
        assert_eq!(first_ms(&period), message.cycle_time_ms, "{name}: {period}");
        let times = repetition.split_once(" times").map(|(count, _)| count.parse().unwrap());
        assert_eq!((times, first_ms(&repetition)), (message.repetition.count, message.repetition.period_ms), "{name}");
        let three_periods = message.cycle_time_ms.map(|period_ms| 3 * period_ms);
        assert!(first_ms(&timeout) == three_periods || ["Alarm", "Reply"].contains(name), "{name}: {timeout}");
    }
    let pass_time = &database.signal("PACKWATCH_Digest.PassTime").unwrap().1.layout;
    // The highest code means "not available". Each alarm takes 20 ms.
    let longest_s = f64::from((1_u32 << pass_time.length_bits) - 2) * pass_time.factor;
    let ends =
        format!("`PassTime` ends at {longest_s:.1} s, the pass of 10,{:03.0} raised", longest_s / 0.02 - 10_000.0);
    assert!(CONTRACT.contains(&ends), "{ends}");
    const NOT_AVAILABLE: &str = "not available";
    const SEVERITIES: [(i64, &str); 4] = [(0, "none"), (1, "info"), (2, "warning"), (3, "severe")];
    const RULE_STATES: [&str; 6] = ["none", "info", "warning", "severe", "unknown", "not watched"];
    for (signal, named, last) in [
        ("PACKWATCH_Health.Page", HEALTH_PAGES.as_slice(), 15),
        ("PACKWATCH_Digest.Page", &["alarms", "rules", "threshold", "rules_2"], 15),
        ("PACKWATCH_Alarm.State", &["inactive", "active", "cleared", "pending", "latched", "suppressed", "unknown"], 7),
    ] {
        let wanted = (0..).zip(named.iter().copied()).chain([(last, NOT_AVAILABLE)]).collect::<Vec<_>>();
        assert_eq!(words(&database, signal), wanted, "{signal}");
    }
    for (signal, named, last) in [
        ("PACKWATCH_Status.Mode", ["unknown", "charge", "rest", "discharge"].as_slice(), 7),
        ("PACKWATCH_Status.Validity", &["unavailable", "valid", "degraded", "untrusted"], 7),
        ("PACKWATCH_Status.HighestSeverity", &SEVERITIES.map(|(_, word)| word), 7),
        ("PACKWATCH_Status.UnknownRules", &["none", "some", "all"], 3),
        ("PACKWATCH_Health.ModelState", &["prior", "learning", "learned", "unfit", "given"], 7),
        ("PACKWATCH_Digest.Worst", &SEVERITIES.map(|(_, word)| word), 7),
    ] {
        let wanted = (0..).zip(named.iter().copied()).chain([(last, NOT_AVAILABLE)]).collect::<Vec<_>>();
        assert_eq!(words(&database, signal), wanted, "{signal}");
    }
    for (signal, of_zero) in [
        ("PACKWATCH_Alarm.Severity", NOT_AVAILABLE),
        ("PACKWATCH_Digest.ThresholdSeverity", NOT_AVAILABLE),
        ("PACKWATCH_Reply.Severity", NOT_AVAILABLE),
        ("PACKWATCH_Command.Severity", "all"),
    ] {
        let wanted = [&[(0, of_zero)], &SEVERITIES[1..]].concat();
        assert_eq!(words(&database, signal), wanted, "{signal}");
    }
    assert_eq!(words(&database, "PACKWATCH_Alarm.Test"), [(0, "real"), (1, "test")]);
    assert_eq!(words(&database, "PACKWATCH_Alarm.Acknowledged"), [(0, "no"), (1, "yes")]);
    const COMMANDS: [(i64, &str); 3] = [(1, "acknowledge"), (2, "clear"), (3, "pack_replaced")];
    assert_eq!(words(&database, "PACKWATCH_Command.Command"), COMMANDS);
    assert_eq!(words(&database, "PACKWATCH_Reply.Command"), [COMMANDS.as_slice(), &[(15, NOT_AVAILABLE)]].concat());
    for (number, (rule, ..)) in RULES.iter().enumerate() {
        let name = format!("PACKWATCH_Digest.Rule_{rule}");
        let wanted = (0..).zip(RULE_STATES).chain([(7, NOT_AVAILABLE)]).collect::<Vec<_>>();
        assert_eq!(words(&database, &name), wanted, "{name}");
        let page = if number < RULES_ON_PAGE_1 { 1 } else { 3 };
        let conditions = &database.signal(&name).unwrap().1.conditions;
        assert_eq!(conditions.iter().flat_map(|of| &of.ranges).collect::<Vec<_>>(), [&(page, page)], "{name}");
    }
    assert_eq!(words(&database, "PACKWATCH_Reply.Result"), [(1, "accepted"), (2, "refused"), (7, NOT_AVAILABLE)]);
    assert_eq!(
        words(&database, "PACKWATCH_Reply.Reason"),
        [
            (0, "none"),
            (1, "first frame"),
            (2, "wrong checksum"),
            (3, "repeated counter"),
            (4, "wrong counter"),
            (5, "no meaning"),
            (6, "not healthy"),
            (7, "nothing to do"),
            (8, "not authentic"),
            (9, "old freshness"),
            (10, "repeat needed"),
            (15, NOT_AVAILABLE),
        ]
    );
}

#[test]
fn command_encoded_with_dbc_is_understood() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("written.dbc");
    for case in Case::all() {
        let database = case.layout();
        std::fs::write(&path, database.to_dbc_bytes()).unwrap();
        let header = match case.profile {
            None => String::new(),
            Some(Profile::P01C) => " E2eCrc=0 E2eCounter=0 E2eDataIdNibble=0".to_owned(),
            Some(Profile::P01A | Profile::P05) => " E2eCrc=0 E2eCounter=0".to_owned(),
        };
        let lines = [
            format!("PACKWATCH_Command Command=clear Rule=BmsDisagrees Severity=severe Cell=95{header}"),
            format!("PACKWATCH_Command Command=pack_replaced Rule=all Severity=all Cell=all{header}"),
        ];
        let answers = ask(&python, &path, &["encode", "strict"], &lines);
        let plan = CommandPlan::new(&database).unwrap();
        let decoded: Vec<_> =
            answers.iter().map(|answer| plan.decode(&frame(plan.id(), case.fd, answer)).unwrap()).collect();
        assert_eq!((decoded[0].command, decoded[0].rule, decoded[0].severity), (Command::Clear, Some(12), Some(3)));
        assert_eq!(decoded[0].cell, Some(CellIndex(95)));
        assert_eq!((decoded[1].command, decoded[1].rule, decoded[1].severity), (Command::PackReplaced, None, None));
        assert_eq!(decoded[1].cell, None);
    }
}

fn frame(id: CanId, fd: bool, hex: &str) -> Frame {
    let byte = |place: usize| u8::from_str_radix(&hex[place..place + 2], 16).unwrap();
    let bytes: Vec<u8> = (0..hex.len()).step_by(2).map(byte).collect();
    if fd { Frame::fd(id, true, false, &bytes) } else { Frame::classic(id, &bytes) }.unwrap()
}

#[test]
fn dbc_command_writes_configured_dbc() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.dbc");
    std::fs::write(&path, "old").unwrap();
    let packwatch = || assert_cmd::Command::cargo_bin("packwatch").unwrap();
    let config = root.join("config/example.toml");
    let shown = packwatch().arg("dbc").arg("-c").arg(&config).assert().success().get_output().stdout.clone();
    packwatch().arg("dbc").arg("-c").arg(&config).arg("-o").arg(&path).assert().success();
    assert_eq!(std::fs::read(&path).unwrap(), shown, "an existing file must be replaced");
    let written = Database::parse_bytes(&shown).unwrap();
    assert_eq!(written, packwatch::config::load(&config).unwrap().output_layout.unwrap());
    let silent = std::fs::read_to_string(&config).unwrap().replace("\n[output]\n", "\n[output]\nenabled = false\n");
    let silent = silent.replace("cells/", &format!("{}/config/cells/", root.display()));
    let silent = silent.replace("\"pack96.dbc\"", &format!("\"{}/config/pack96.dbc\"", root.display()));
    let silent_path = folder.path().join("silent.toml");
    std::fs::write(&silent_path, silent).unwrap();
    let error = packwatch().arg("dbc").arg("-c").arg(&silent_path).assert().code(78).get_output().stderr.clone();
    assert!(String::from_utf8_lossy(&error).contains("nothing is sent"), "{}", String::from_utf8_lossy(&error));
    packwatch().args(["dbc", "-c", "none.toml"]).assert().code(78);
    packwatch().arg("dbc").arg("-c").arg(&config).args(["-o", "/dev/full"]).assert().code(1);
}
