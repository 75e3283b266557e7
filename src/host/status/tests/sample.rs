//! Creates a sample document for tests, in which nearly all values are known.

use crate::alarm::{Alarm, AlarmState, Rule, Severity};
use crate::can::poll::PollSilence;
use crate::can::uds::ControllerCounts;
use crate::cell_faults::{CellFault, CellFaultKind};
use crate::config::VehicleIdentity;
use crate::control::protocol::UnknownAlarms;
use crate::filter::ScalarGaussian;
use crate::health::UseRecord;
use crate::io::socket::{LinkCounts, LinkState};
use crate::monitor::{
    AlarmCounts, BusStatistics, CellView, LearningCounts, ModelState, MovedSums, PackView, Statistics, Validity,
    VoltageCounts,
};
use crate::quantity::catalogue::{CellValues, Estimate, PackValues, Quantity, Values};
use crate::quantity::{CellIndex, Mode, Timestamp};
use crate::sample::ReadingCounts;
use crate::status::counters::{ClientCounts, Latency, ServiceCounters};
use crate::status::document::{
    AlarmStatus, CommandStatus, ConfigFile, ControllerStatus, InterfaceStatus, MessageFlood, MessageProtection,
    PollStatus, StatusCount, StatusCounters, StatusDocument, StoreStatus, VERSION,
};

/// The document of a pack. If the pack has two or more cells, the last cell sends no data. If the pack has three or
/// more cells, the estimate of the second-last cell is untrusted.
pub(crate) fn sample(cells: u16) -> StatusDocument {
    let mut latency = Latency::default();
    [40e-6, 80e-6, 80e-6, 300e-6, 3e-3].into_iter().for_each(|seconds| latency.record(seconds));
    let time = Timestamp::from_secs(1_800_000_000.0);
    StatusDocument {
        version: VERSION,
        program_version: "1.2.3".to_owned(),
        pid: 4711,
        time,
        wall_time: time,
        started: time.plus_secs(-11_520.0),
        uptime_s: 11_520.0,
        config: Some(ConfigFile {
            path: "pack.toml".to_owned(),
            drop_ins: Vec::new(),
            sha256: "0123456789abcdef".repeat(4),
        }),
        vehicle: VehicleIdentity::default(),
        state: Validity::Valid,
        interfaces: vec![interface("can0", LinkState::Up), interface("can1", LinkState::Missing)],
        pack: pack(cells),
        cells: (0..cells).map(|index| cell(index, cells)).collect(),
        alarms: alarms(),
        counters: StatusCounters {
            core: core(),
            lifetime: Statistics {
                buses: Vec::new(),
                learning: LearningCounts { half_cycles: 1200, ..core().learning },
                ..core()
            },
            readings: ReadingCounts { accepted: 123_456, out_of_range: 7, ..ReadingCounts::default() },
            time_backwards: 2,
            service: ServiceCounters {
                ticks: 1_152_000,
                missed_deadlines: 3,
                worst_lateness_s: 0.021,
                reloads: 1,
                reloads_refused: 0,
                documents_skipped: 0,
            },
            clients: ClientCounts { connected: 1, served: 90, refused: 5, dropped: 2 },
        },
        protection: vec![MessageProtection {
            interface: "can0".to_owned(),
            id: "3E9".to_owned(),
            checks: vec![StatusCount { status: "ok".to_owned(), count: 99 }],
        }],
        commands: Some(CommandStatus { interface: "can0".to_owned(), id: "6B3".to_owned(), secoc: None }),
        controllers: vec![ControllerStatus {
            interface: "can0".to_owned(),
            id: "7EC".to_owned(),
            counts: ControllerCounts {
                read: 120,
                refused: 3,
                latest_refusal: Some(0x31),
                lost: [2, 0, 0, 0, 0, 0, 0, 0],
                ..ControllerCounts::default()
            },
        }],
        asleep_since: None,
        poll: Some(PollStatus { silent: Some(PollSilence::OtherTester), refused: 1 }),
        intruders: Vec::new(),
        current_frozen: false,
        findings: vec![CellFault {
            kind: CellFaultKind::Leak,
            cells: Some((CellIndex(0), CellIndex(0))),
            since: Timestamp::from_secs(1_799_800_000.0),
            reported: Timestamp::from_secs(1_799_900_000.0),
            probability: 0.9995,
            size: ScalarGaussian { mean: 0.0015, variance: 1e-8 },
        }],
        floods: vec![MessageFlood { interface: "can0".to_owned(), id: "18FF0010".to_owned(), dropped: 12 }],
        latency,
        store: Some(StoreStatus {
            path: "/var/lib/packwatch/packwatch.db".to_owned(),
            works: Some(true),
            commits: 21,
            file_bytes: Some(65_536),
            ..StoreStatus::default()
        }),
        event_count: 2,
        events: vec![
            serde_json::json!({ "time": time.nanos(), "event": "mode", "from": "rest", "to": "discharge" }),
            serde_json::json!({ "time": time.nanos(), "event": "trust", "cell": 2, "trusted": false, "mean_nis": 3.25 }),
        ],
    }
}

fn interface(name: &str, state: LinkState) -> InterfaceStatus {
    InterfaceStatus {
        name: name.to_owned(),
        state,
        reconnects: 1,
        received: BusStatistics { frames: 86_400, error_frames: 4, bus_offs: 1 },
        link: LinkCounts {
            kernel_dropped: 6,
            queue_dropped: 0,
            malformed: 0,
            sent: 1200,
            send_queue_full: 8,
            send_failed: 9,
        },
    }
}

fn pack(cells: u16) -> PackView {
    let mut values = PackValues::default();
    for (quantity, mean, std) in [
        (Quantity::Soc, 0.632, Some(0.012)),
        (Quantity::SocLow, 0.608, None),
        (Quantity::SocHigh, 0.656, None),
        (Quantity::Voltage, 3.65 * f64::from(cells), None),
        (Quantity::Current, 12.5, None),
        (Quantity::CurrentOffset, -0.034, Some(0.011)),
        (Quantity::TemperatureMax, 31.25, None),
        (Quantity::Capacity, 2.412, Some(0.021)),
        (Quantity::Soh, 0.928, Some(0.008)),
        (Quantity::UsableCapacity, 2.31, Some(0.04)),
        (Quantity::NormalisedRechargePeriod, 5432.0, Some(61.0)),
        (Quantity::RemainingEnergy, 541.0, Some(23.0)),
        (Quantity::TimeToEmpty, 4321.0, Some(600.0)),
        (Quantity::DischargePower10s, 8210.0, Some(410.0)),
        (Quantity::FastCharges, 12.0, None),
    ] {
        values.set(quantity, Some(Estimate { mean, std }));
    }
    PackView {
        model_state: Some(ModelState::Learning),
        model_fits_better: None,
        validity: Validity::Valid,
        mode: Mode::Discharge,
        limiting_cell: Some(CellIndex(0)),
        weakest_cell: Some(CellIndex(0)),
        shortest_lived_cell: Some(CellIndex(0)),
        power_limiting_cells: Some([CellIndex(0), CellIndex(0)]),
        moved: Some(MovedSums {
            charged_ah: 1210.5,
            discharged_ah: 1180.25,
            charged_wh: 424_000.0,
            discharged_wh: 406_000.0,
        }),
        use_record: Some(UseRecord::default()),
        values: with_life(values, 0.061, 412.3),
    }
}

/// Adds the loss modes (lost lithium and active material) and the remaining life to `values`.
fn with_life<const IS_PACK: bool>(mut values: Values<IS_PACK>, lli: f64, cycles: f64) -> Values<IS_PACK> {
    for (quantity, mean, std) in [
        (Quantity::LithiumLoss, lli, Some(0.012)),
        (Quantity::NegativeLoss, 0.022, Some(0.023)),
        (Quantity::PositiveLoss, 0.021, Some(0.024)),
        (Quantity::RemainingCycles, cycles, None),
        (Quantity::RemainingCyclesLow, 207.8, None),
        (Quantity::RemainingCyclesHigh, 933.1, None),
        (Quantity::RemainingDays, 533.2, None),
    ] {
        values.set(quantity, Some(Estimate { mean, std }));
    }
    values
}

fn cell(index: u16, cells: u16) -> CellView {
    let wave = f64::from(index % 24) / 24.0;
    let is_silent = cells > 1 && index + 1 == cells;
    let mut values = CellValues::default().with(Quantity::Current, Some(12.5));
    if !is_silent {
        for (quantity, mean, std) in [
            (Quantity::Voltage, 3.6 + 0.1 * wave, None),
            (Quantity::Temperature, 25.0 + 6.0 * wave, None),
            (Quantity::Soc, 0.6 + 0.2 * wave, Some(0.012)),
            (Quantity::Capacity, 2.4 + 0.05 * wave, Some(0.02)),
            (Quantity::ResistanceRatio, 1.1 + 0.2 * wave, Some(0.03)),
        ] {
            values.set(quantity, Some(Estimate { mean, std }));
        }
        values = with_life(values, 0.06 + 0.01 * wave, 412.3 + wave);
    }
    CellView {
        cell: CellIndex(index),
        values,
        remaining_unknown: is_silent.then(|| "0 capacity readings, needs 6".to_owned()),
        trusted: (!is_silent).then_some(cells < 3 || index + 2 != cells),
    }
}

fn alarms() -> AlarmStatus {
    let raised = Alarm {
        rule: Rule::CapacityLow,
        severity: Severity::Severe,
        cell: Some(CellIndex(0)),
        state: AlarmState::Active,
        value: Some(2.412),
        probability: Some(0.973),
        threshold: 2.5,
        occurrences: 1,
        first_raised: Some(Timestamp::ZERO),
        last_raised: Some(Timestamp::ZERO),
        raised_value: Some(2.42),
        is_acknowledged: false,
    };
    let past =
        Alarm { rule: Rule::SocLow, severity: Severity::Warning, cell: None, state: AlarmState::Cleared, ..raised };
    let past = Alarm { value: Some(0.632), threshold: 0.1, probability: None, is_acknowledged: true, ..past };
    AlarmStatus {
        thresholds: 4,
        rules: vec![Rule::CapacityLow, Rule::RechargePeriodLow, Rule::SocLow],
        raised: 1,
        highest_severity: Some(Severity::Severe),
        unknown: vec![UnknownAlarms { rule: Rule::RechargePeriodLow, severity: Severity::Warning, alarms: 1 }],
        list: vec![raised, past],
        omitted: 0,
    }
}

fn core() -> Statistics {
    Statistics {
        buses: vec![BusStatistics { frames: 86_400, error_frames: 4, bus_offs: 1 }],
        voltages: VoltageCounts { used: 120_000, gated: 11, without_current: 0 },
        learning: LearningCounts { half_cycles: 12, capacity_updates: 12, ..LearningCounts::default() },
        alarms_raised: AlarmCounts { info: 0, warning: 1, severe: 1 },
        ..Statistics::default()
    }
}
