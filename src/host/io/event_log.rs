//! Writes core events as log lines with fields. The kind of an event decides its log level. For an alarm, the severity
//! decides too. Error frames, lost frames and unsent frames are logged once and then as counts, because a bus without
//! another node causes thousands of error frames per second. In the JSON format, every event is written.

mod text;

pub use text::command as command_words;
pub use text::word;

use std::io::{self, Write};

use crate::alarm::{Change, Severity};
use crate::can::flood::FloodChange;
use crate::can::guard::GuardChange;
use crate::can::j1939::NodeEvent;
use crate::can::own_frames::OwnIdChange;
use crate::can::poll::PollChange;
use crate::can::rate::SenderChange;
use crate::can::uds::MessageLoss;
use crate::cell::Chemistry;
use crate::cell_faults::CellFault;
use crate::config::VehicleIdentity;
use crate::monitor::{BusEvent, Event, EventKind, ModelState, Source};
use crate::quantity::catalogue::Quantity;
use crate::quantity::{BusIndex, CellIndex, Timestamp};

/// Writes one event as a line of JSON, the format of `--events` in `run` and `replay`.
pub fn write_line(out: &mut impl Write, event: &Event) -> io::Result<()> {
    out.write_all(&serde_json::to_vec(event)?)?;
    out.write_all(b"\n")
}

/// If a vehicle is configured, writes the first line of an event file, which identifies the vehicle.
pub fn write_head(out: &mut impl Write, vehicle: &VehicleIdentity) -> io::Result<()> {
    if !vehicle.is_stated() {
        return Ok(());
    }
    serde_json::to_writer(&mut *out, &serde_json::json!({ "vehicle": vehicle }))?;
    out.write_all(b"\n")
}

/// Counts the frames of one kind on one interface, for the log.
#[derive(Debug, Clone, Copy, Default)]
struct EventSum {
    reported: Option<Timestamp>,
    unreported: u64,
    /// Minimum time between two log lines (s).
    period_s: f64,
}

impl EventSum {
    /// Adds frames. If a line is due, returns the number of frames to log.
    fn add(&mut self, time: Timestamp, frames: u64) -> Option<u64> {
        self.unreported = self.unreported.saturating_add(frames);
        let since_s = self.reported.map_or(f64::INFINITY, |reported| time.since(reported));
        if since_s < self.period_s {
            return None;
        }
        // After a pause, the next frames are logged at once. While frames continue, counts are logged at intervals that
        // start at 10 s and double up to one hour.
        let continues = since_s < 2.0 * self.period_s;
        self.period_s = if continues { (2.0 * self.period_s).min(3600.0) } else { 10.0 };
        self.reported = Some(time);
        Some(std::mem::take(&mut self.unreported))
    }
}

#[derive(Debug, Clone, Copy, Default)]
struct InterfaceSums {
    errors: EventSum,
    dropped: EventSum,
    unsent: EventSum,
}

/// Writes events to the log.
#[derive(Debug)]
pub struct EventLog {
    interfaces: Vec<String>,
    sums: Vec<InterfaceSums>,
}

impl EventLog {
    /// Creates a log for these interfaces, which are in configuration order.
    pub fn new(interfaces: Vec<String>) -> Self {
        let sums = vec![InterfaceSums::default(); interfaces.len()];
        Self { interfaces, sums }
    }

    /// Logs one event.
    pub fn log(&mut self, event: &Event) {
        match event.kind {
            EventKind::Bus { bus, what } => self.log_bus(event.time, bus.index(), what),
            EventKind::Alarm { .. } => log_alarm(&event.kind),
            EventKind::HalfCycle { .. }
            | EventKind::Capacity { .. }
            | EventKind::LossModes { .. }
            | EventKind::RemainingLife { .. }
            | EventKind::Outlook { .. }
            | EventKind::RechargePeriod { .. } => {
                log_learned(&event.kind);
            }
            EventKind::SignalBad { channel, fault } => {
                tracing::warn!(channel = text::channel(channel), fault = word(fault), "signal bad");
            }
            EventKind::SignalGood { channel, bad_readings } => {
                tracing::info!(channel = text::channel(channel), bad_readings, "signal good");
            }
            EventKind::Protection(change) => self.log_protection(change),
            EventKind::Flood(FloodChange { bus, id, active: true, .. }) => {
                tracing::warn!(interface = self.name(bus), %id, "frame rate too high, dropping frames");
            }
            EventKind::Flood(FloodChange { bus, id, dropped, .. }) => {
                tracing::info!(interface = self.name(bus), %id, dropped, "frame rate normal again");
            }
            EventKind::SecondSender(SenderChange { bus, id, active: true, frames_per_s, expected_per_s }) => {
                let expected_per_s = rounded(expected_per_s);
                tracing::warn!(interface = self.name(bus), %id, frames_per_s, expected_per_s, "second sender");
            }
            EventKind::SecondSender(SenderChange { bus, id, .. }) => {
                tracing::info!(interface = self.name(bus), %id, "second sender stopped");
            }
            EventKind::OwnIdentifier(OwnIdChange { bus, id, active: true, .. }) => {
                tracing::warn!(interface = self.name(bus), %id, "another node sends one of our identifiers");
            }
            EventKind::OwnIdentifier(OwnIdChange { bus, id, frames, .. }) => {
                tracing::info!(interface = self.name(bus), %id, frames, "no other node sends our identifiers");
            }
            EventKind::MessageLoss(MessageLoss { bus, id, fault, lost }) => {
                tracing::warn!(interface = self.name(bus), %id, lost, "diagnostic message lost: {}", fault.words());
            }
            EventKind::Poll(change) => log_poll(change),
            EventKind::BusAsleep { asleep: true, .. } => tracing::info!("buses asleep"),
            EventKind::BusAsleep { asleep: false, seconds } => {
                tracing::info!(seconds = seconds.map(rounded), "buses awake");
            }
            EventKind::FilterReset { cell } => tracing::warn!(cell = number(cell), "filter restarted"),
            EventKind::Model { .. } => log_model(&event.kind),
            EventKind::Finding(CellFault { kind, cells, size, probability, .. }) => {
                let (first, last) = cells.map(|(first, last)| (number(first), number(last))).unzip();
                let [size, size_std, probability] = [size.mean, size.std(), probability].map(rounded);
                tracing::warn!(first, last, size, size_std, probability, "{}: {}", kind.words(), kind.advice());
            }
            EventKind::TimeBackwards { seconds } => tracing::warn!(seconds = rounded(seconds), "time went backwards"),
            EventKind::Trust { cell, trusted: false, mean_nis } => {
                tracing::warn!(cell = number(cell), mean_nis = rounded(mean_nis), "estimate untrusted");
            }
            EventKind::Trust { cell, trusted: true, mean_nis } => {
                tracing::info!(cell = number(cell), mean_nis = rounded(mean_nis), "estimate trusted again");
            }
            EventKind::J1939 { what } => log_j1939(what),
            EventKind::Mode { from, to } => tracing::info!(from = word(from), to = word(to), "mode"),
            EventKind::Command { source, command, changed, refused } => {
                let source = match source {
                    Source::Local => "this computer",
                    Source::Bus(bus) => self.name(bus),
                };
                tracing::info!(source, command = text::command(&command), changed, refused, "command");
            }
            EventKind::BadCommand { bus, intact, reason } => {
                tracing::warn!(
                    interface = self.name(bus),
                    intact,
                    reason = reason.words(),
                    "command frame not executed"
                );
            }
            EventKind::Test { rule, running } => {
                tracing::info!(
                    rule = rule.name(),
                    "{}",
                    if running { "alarm test started" } else { "alarm test ended" }
                );
            }
            EventKind::PackReplaced { capacity_ah, capacity_std_ah } => {
                let (capacity_ah, capacity_std_ah) = (capacity_ah.map(rounded), capacity_std_ah.map(rounded));
                tracing::warn!(
                    capacity_ah,
                    capacity_std_ah,
                    "pack replaced: learned values of the old pack no longer apply"
                );
            }
            EventKind::PackReturned { identity, capacity_ah, capacity_std_ah } => {
                let (capacity_ah, capacity_std_ah) = (capacity_ah.map(rounded), capacity_std_ah.map(rounded));
                tracing::info!(
                    identity,
                    capacity_ah,
                    capacity_std_ah,
                    "known pack connected: its learned values are restored"
                );
            }
            EventKind::PackIdentity { identity } => tracing::info!(identity, "pack identity"),
            EventKind::Reconfigured { alarms_ended } => tracing::info!(alarms_ended, "configuration changed"),
            EventKind::AlarmDropped { rule, severity, cell, active, occurrences } => {
                let cell = cell.map(number);
                tracing::warn!(
                    rule = rule.name(),
                    severity = severity.name(),
                    cell,
                    active,
                    occurrences,
                    "stored alarm dropped: no rule monitors it now"
                );
            }
            EventKind::Store { works: true } => tracing::info!("files can be written"),
            EventKind::Store { works: false } => tracing::error!("a file cannot be written"),
            EventKind::Gap { seconds } => tracing::info!(seconds = seconds.map(rounded), "gap"),
        }
    }

    fn name(&self, bus: BusIndex) -> &str {
        self.interfaces.get(bus.index()).map_or("?", String::as_str)
    }

    fn log_protection(&self, GuardChange { bus, id, status, usable, count }: GuardChange) {
        let (interface, status) = (self.name(bus), status.name());
        if usable {
            tracing::info!(interface, %id, status, failed = count, "protected message usable again");
        } else {
            tracing::warn!(interface, %id, status, failed = count, "protected message fails its check");
        }
    }

    fn log_bus(&mut self, time: Timestamp, bus: usize, what: BusEvent) {
        let interface = self.interfaces.get(bus).map_or("?", String::as_str);
        let Some(sums) = self.sums.get_mut(bus) else { return };
        match what {
            BusEvent::Up => tracing::info!(interface, "interface up"),
            BusEvent::Down => tracing::warn!(interface, "interface down"),
            BusEvent::Missing => tracing::warn!(interface, "interface missing"),
            BusEvent::Dropped { frames } => {
                if let Some(frames) = sums.dropped.add(time, frames) {
                    tracing::warn!(interface, frames, "received frames lost");
                }
            }
            BusEvent::SendFailed { frames } => {
                if let Some(frames) = sums.unsent.add(time, frames) {
                    tracing::warn!(interface, frames, "frames not sent");
                }
            }
            BusEvent::ErrorFrame { class } => {
                if let Some(frames) = sums.errors.add(time, 1) {
                    tracing::warn!(interface, frames, class = format_args!("{class:#x}"), "error frames");
                }
            }
        }
    }
}

/// Rounds to nine significant digits, which removes the digits that binary arithmetic adds. No logged value is known
/// more exactly.
fn rounded(value: f64) -> f64 {
    format!("{value:.8e}").parse().unwrap_or(value)
}

/// The number of a cell for users, counted from 1.
fn number(cell: CellIndex) -> u32 {
    u32::from(cell.0) + 1
}

fn log_j1939(event: NodeEvent) {
    match event {
        NodeEvent::Claimed { address } => tracing::info!(address, "J1939 address claimed"),
        NodeEvent::AddressLost { to } => tracing::warn!(name = %to, "J1939 address lost to another node"),
        NodeEvent::AddressDefended { against } => tracing::info!(name = %against, "J1939 address defended"),
        NodeEvent::CodesLeftOut { codes: 0 } => tracing::info!("J1939 message contains all trouble codes again"),
        NodeEvent::CodesLeftOut { codes } => tracing::warn!(codes, "J1939 trouble codes do not fit into the message"),
    }
}

fn log_poll(change: PollChange) {
    match change {
        PollChange::Silent { reason } => tracing::info!("diagnostic requests paused: {}", reason.words()),
        PollChange::Asking => tracing::info!("diagnostic requests started"),
        PollChange::Refused { id, service, identifier, code } => {
            let request = format!("{service:02X} {identifier:04X}");
            tracing::warn!(%id, request, "diagnostic request rejected with code {code:02X}: not sent again");
        }
    }
}

fn log_model(kind: &EventKind) {
    let EventKind::Model { state, capacity_ah, capacity_std_ah, residual_v, chemistry, is_taken_back } = *kind else {
        return;
    };
    let chemistry = chemistry.map(Chemistry::name);
    let [capacity_ah, capacity_std_ah, residual_v] =
        [capacity_ah, capacity_std_ah, residual_v].map(|value| value.map(rounded));
    match state {
        ModelState::Unfit => {
            tracing::warn!(fits_better = chemistry, "the voltages contradict the chemistry on the label")
        }
        _ if is_taken_back => {
            tracing::warn!(state = word(state), capacity_ah, "cell model reverted: the previous one was better")
        }
        _ => tracing::info!(state = word(state), capacity_ah, capacity_std_ah, residual_v, "cell model learned"),
    }
}

fn log_alarm(kind: &EventKind) {
    let EventKind::Alarm { rule, cell, change, severity, value, probability, threshold, occurrences, .. } = *kind
    else {
        return;
    };
    let (cell, value) = (cell.map(number), value.map(|value| rule.with_unit(value)));
    let (probability, threshold) = (probability.map(rounded), rule.with_unit(threshold));
    let what = match change {
        Change::Raised => "alarm raised",
        Change::Suppressed => "alarm still raised, value unknown",
        Change::Resumed => "alarm still raised, value known again",
        Change::Latched => "alarm latched",
        Change::Cleared => "alarm cleared",
        Change::Acknowledged => "alarm acknowledged",
        Change::Forgotten => "alarm forgotten",
    };
    let (rule, is_info, severity) = (rule.name(), severity == Severity::Info, severity.name());
    if change == Change::Raised && !is_info {
        tracing::warn!(rule, cell, severity, value, probability, threshold, occurrences, "{what}");
    } else {
        tracing::info!(rule, cell, severity, value, probability, threshold, occurrences, "{what}");
    }
}

fn log_learned(kind: &EventKind) {
    let known = |value: Option<f64>| value.map(rounded);
    match *kind {
        EventKind::HalfCycle { cell, mode, charge_ah, swing, swing_std, duration_s, .. } => {
            let (charge_ah, duration_s) = (rounded(charge_ah), rounded(duration_s));
            let (swing, swing_std) = (known(swing), known(swing_std));
            tracing::info!(
                cell = number(cell),
                mode = word(mode),
                charge_ah,
                swing,
                swing_std,
                duration_s,
                "half-cycle"
            );
        }
        EventKind::Capacity { cell, measured_ah, values, .. } => {
            let mean = |quantity| known(values.mean(quantity));
            tracing::info!(
                cell = number(cell),
                measured_ah = known(measured_ah),
                capacity_ah = mean(Quantity::Capacity),
                capacity_std_ah = known(values.pair(Quantity::Capacity).map(|(_, std)| std)),
                usable_capacity_ah = mean(Quantity::UsableCapacity),
                resistance_ratio = mean(Quantity::ResistanceRatio),
                "capacity"
            );
        }
        EventKind::LossModes { cell, lli, lli_std, lam_ne, lam_ne_std, lam_pe, lam_pe_std } => {
            let [lli, lli_std, lam_ne, lam_ne_std, lam_pe, lam_pe_std] =
                [lli, lli_std, lam_ne, lam_ne_std, lam_pe, lam_pe_std].map(rounded);
            tracing::info!(cell = number(cell), lli, lli_std, lam_ne, lam_ne_std, lam_pe, lam_pe_std, "loss modes");
        }
        EventKind::RemainingLife { cell, cycles, cycles_low, cycles_high, days, .. } => {
            let [cycles, cycles_low, cycles_high, days] = [cycles, cycles_low, cycles_high, days].map(known);
            tracing::info!(cell = cell.map(number), cycles, cycles_low, cycles_high, days, "remaining life");
        }
        EventKind::Outlook { values } => {
            let mean = |quantity| known(values.mean(quantity));
            tracing::info!(
                remaining_energy_wh = mean(Quantity::RemainingEnergy),
                energy_to_full_wh = mean(Quantity::EnergyToFull),
                energy_soh = mean(Quantity::EnergySoh),
                discharge_power_10s_w = mean(Quantity::DischargePower10s),
                charge_power_10s_w = mean(Quantity::ChargePower10s),
                "energy and power"
            );
        }
        EventKind::RechargePeriod { seconds, normalised_s, normalised_std_s } => {
            let [seconds, normalised_s, normalised_std_s] = [seconds, normalised_s, normalised_std_s].map(known);
            tracing::info!(seconds, normalised_s, normalised_std_s, "recharge period");
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alarm::{AlarmState, Change, Rule, Severity};
    use crate::cell_faults::CellFaultKind;
    use crate::filter::ScalarGaussian;
    use crate::quantity::Mode;
    use crate::quantity::catalogue::{RECORDED, RECORDED_OF_PACK, RecordedPackValues, RecordedValues};

    #[test]
    fn day_of_errors_gives_forty_complete_lines() {
        let mut sum = EventSum::default();
        let logged: Vec<u64> =
            (0..86_400 * 4).filter_map(|n| sum.add(Timestamp::from_secs(f64::from(n) * 0.25), 2)).collect();
        assert!((20..=45).contains(&logged.len()), "{} lines", logged.len());
        assert_eq!(logged[0], 2, "the first error frame is logged at once");
        assert_eq!(logged.iter().sum::<u64>() + sum.unreported, 86_400 * 4 * 2);
    }

    #[test]
    fn count_saturates_at_maximum() {
        let mut sum = EventSum::default();
        let sums = [0.0, 1.0, 2.0, 10.0].map(|at_s| sum.add(Timestamp::from_secs(at_s), u64::MAX));
        assert_eq!(sums, [Some(u64::MAX), None, None, Some(u64::MAX)]);
    }

    #[test]
    fn rounding_removes_binary_digits() {
        assert_eq!(format!("{:?}", rounded(0.7 * 2.6)), "1.82");
        assert_eq!(
            (rounded(45.0), rounded(-0.1), rounded(1e-12), rounded(123_456.789)),
            (45.0, -0.1, 1e-12, 123_456.789)
        );
        assert!(rounded(f64::NAN).is_nan());
    }

    #[derive(Clone, Default)]
    struct Lines(std::sync::Arc<std::sync::Mutex<Vec<u8>>>);

    impl Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn learned_values_are_logged_rounded() {
        let (x, known, cell) = (0.7 * 2.6, Some(0.7 * 2.6), CellIndex(72));
        let (size, since) = (ScalarGaussian { mean: x, variance: x }, Timestamp::ZERO);
        let finding = CellFault {
            kind: CellFaultKind::Leak,
            cells: Some((cell, cell)),
            since,
            reported: since,
            probability: x,
            size,
        };
        let kinds = [
            EventKind::HalfCycle {
                cell,
                mode: Mode::Discharge,
                charge_ah: x,
                swing: known,
                swing_std: known,
                duration_s: x,
                mean_current_a: x,
                mean_temperature_c: known,
            },
            EventKind::Capacity {
                cell,
                measured_ah: known,
                measured_std_ah: known,
                values: RECORDED
                    .into_iter()
                    .fold(RecordedValues::default(), |values, it| values.with(it, Some((x, x)))),
            },
            EventKind::LossModes { cell, lli: x, lli_std: x, lam_ne: x, lam_ne_std: x, lam_pe: x, lam_pe_std: x },
            EventKind::RemainingLife {
                cell: Some(cell),
                cycles: known,
                cycles_low: known,
                cycles_high: known,
                days: known,
                days_low: known,
                days_high: known,
            },
            EventKind::Outlook {
                values: RECORDED_OF_PACK
                    .into_iter()
                    .fold(RecordedPackValues::default(), |values, it| values.with(it, Some((x, x)))),
            },
            EventKind::Alarm {
                rule: Rule::CapacityLow,
                severity: Severity::Warning,
                cell: Some(cell),
                change: Change::Raised,
                state: AlarmState::Active,
                active: true,
                value: known,
                probability: known,
                threshold: x,
                occurrences: 1,
                acknowledged: false,
            },
            EventKind::RechargePeriod { seconds: known, normalised_s: known, normalised_std_s: known },
            EventKind::Model {
                state: ModelState::Learned,
                capacity_ah: known,
                capacity_std_ah: known,
                residual_v: known,
                chemistry: None,
                is_taken_back: false,
            },
            EventKind::Finding(finding),
            EventKind::BusAsleep { asleep: false, seconds: known },
            EventKind::TimeBackwards { seconds: x },
            EventKind::Trust { cell, trusted: false, mean_nis: x },
            EventKind::PackReplaced { capacity_ah: known, capacity_std_ah: known },
            EventKind::Gap { seconds: known },
        ];
        let lines = Lines::default();
        let writer = lines.clone();
        let subscriber = tracing_subscriber::fmt().with_writer(move || writer.clone()).with_ansi(false).finish();
        tracing::subscriber::with_default(subscriber, || {
            let mut log = EventLog::new(vec!["can0".to_owned()]);
            kinds.iter().for_each(|kind| log.log(&Event { time: Timestamp::ZERO, kind: *kind }));
        });
        let text = String::from_utf8(lines.0.lock().unwrap().clone()).unwrap();
        assert_eq!(text.lines().count(), kinds.len(), "{text}");
        for line in text.lines() {
            let word_of = |key: &str| line.split(' ').find_map(|word| word.strip_prefix(key)).map(str::to_owned);
            assert!(line.contains("1.82"), "{line}");
            assert!(!line.contains("1.81999") && !line.contains("1.82000"), "{line}");
            assert!(!line.contains("Index(") && word_of("cell=").is_none_or(|number| number == "73"), "{line}");
        }
    }

    #[test]
    fn count_after_pause_is_logged_at_once() {
        let mut sum = EventSum::default();
        let mut add = |at_s: f64| sum.add(Timestamp::from_secs(at_s), 1);
        assert_eq!([add(0.0), add(1.0), add(10.0), add(11.0)], [Some(1), None, Some(2), None]);
        assert_eq!([add(1000.0), add(1001.0), add(1010.0)], [Some(2), None, Some(2)]);
    }
}
