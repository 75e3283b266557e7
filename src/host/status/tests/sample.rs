//! A sample document for tests: every value is present, except a few that are unknown.

use crate::alarm::{Alarm, AlarmState, Rule, Severity};
use crate::can::poll::PollSilence;
use crate::can::uds::ControllerCounts;
use crate::cell_faults::{CellFault, CellFaultKind};
use crate::config::VehicleIdentity;
use crate::control::protocol::UnknownAlarms;
use crate::filter::ScalarGaussian;
use crate::io::socket::{LinkCounts, LinkState};
use crate::monitor::{AlarmCounts, BusStatistics, LearningCounts, ModelState, Statistics, Validity, VoltageCounts};
use crate::quantity::{CellIndex, Mode, Timestamp};
use crate::sample::ReadingCounts;
use crate::status::counters::{ClientCounts, Latency, ServiceCounters};
use crate::status::document::{
    AlarmStatus, CellStatus, CommandStatus, ConfigFile, ControllerStatus, InterfaceStatus, LossStatus, MessageFlood,
    MessageProtection, PackStatus, PollStatus, RemainingStatus, StatusCount, StatusCounters, StatusDocument,
    StoreStatus, VERSION,
};

/// The document of a pack. Of several cells, the last one is silent and the one before it is not trusted.
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

fn pack(cells: u16) -> PackStatus {
    PackStatus {
        model_state: Some(ModelState::Learning),
        model_fits_better: None,
        validity: Validity::Valid,
        mode: Mode::Discharge,
        soc: Some(0.632),
        soc_std: Some(0.012),
        soc_low: Some(0.608),
        soc_high: Some(0.656),
        limiting_cell: Some(0),
        voltage_v: Some(3.65 * f64::from(cells)),
        current_a: Some(12.5),
        current_offset_a: Some(-0.034),
        current_offset_std_a: Some(0.011),
        temperature_max_c: Some(31.25),
        weakest_cell: Some(0),
        capacity_ah: Some(2.412),
        capacity_std_ah: Some(0.021),
        soh: Some(0.928),
        losses: losses(0.061),
        shortest_lived_cell: Some(0),
        remaining: remaining(412.3),
        usable_capacity_ah: Some(2.31),
        usable_capacity_std_ah: Some(0.04),
        recharge_period_s: None,
        normalised_recharge_period_s: Some(5432.0),
        normalised_recharge_period_std_s: Some(61.0),
        reported_soc: None,
        reported_soh: None,
    }
}

fn losses(lli: f64) -> LossStatus {
    LossStatus {
        lli: Some(lli),
        lli_std: Some(0.012),
        lam_ne: Some(0.022),
        lam_ne_std: Some(0.023),
        lam_pe: Some(0.021),
        lam_pe_std: Some(0.024),
    }
}

fn remaining(cycles: f64) -> RemainingStatus {
    RemainingStatus {
        remaining_cycles: Some(cycles),
        remaining_cycles_low: Some(207.8),
        remaining_cycles_high: Some(933.1),
        remaining_days: Some(533.2),
    }
}

fn cell(index: u16, cells: u16) -> CellStatus {
    let wave = f64::from(index % 24) / 24.0;
    let is_silent = cells > 1 && index + 1 == cells;
    let known = |value: f64| (!is_silent).then_some(value);
    CellStatus {
        cell: index,
        voltage_v: known(3.6 + 0.1 * wave),
        current_a: Some(12.5),
        temperature_c: known(25.0 + 6.0 * wave),
        soc: known(0.6 + 0.2 * wave),
        soc_std: known(0.012),
        capacity_ah: known(2.4 + 0.05 * wave),
        capacity_std_ah: known(0.02),
        losses: if is_silent { LossStatus::default() } else { losses(0.06 + 0.01 * wave) },
        usable_capacity_ah: None,
        usable_capacity_std_ah: None,
        remaining: if is_silent { RemainingStatus::default() } else { remaining(412.3 + wave) },
        remaining_unknown: is_silent.then(|| "0 capacity readings, needs 6".to_owned()),
        resistance_ratio: known(1.1 + 0.2 * wave),
        resistance_ratio_std: known(0.03),
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
