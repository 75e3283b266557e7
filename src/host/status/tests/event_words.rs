//! Tests the words of every kind of event.

use std::collections::BTreeSet;

use serde_json::json;

use super::super::sample::sample;
use super::*;
use crate::monitor::EventKind;

/// Events of every kind with their words, in two interfaces `can0` and `can1`.
fn rows() -> Vec<(Value, &'static str)> {
    let name = 0x1234_5678_9ABC_DEF0_u64;
    let finding = json!({ "event": "finding", "kind": "leak", "cells": [6, 6], "since": 0, "reported": 0,
        "probability": 1.0, "size": { "mean": 0.1, "variance": 1e-6 } });
    let alarm = json!({ "event": "alarm", "rule": "capacity_low", "cell": 2, "change": "raised", "state": "active",
        "active": true, "severity": "warning", "value": 2.412_345, "threshold": 2.5, "occurrences": 1,
        "acknowledged": false });
    let pack_alarm = json!({ "event": "alarm", "rule": "soc_low", "cell": null, "change": "cleared", "state": "inactive",
        "active": false, "severity": "severe", "value": null, "threshold": 0.1, "occurrences": 1, "acknowledged": false });
    let half_cycle = json!({ "event": "half_cycle", "cell": 0, "mode": "charge", "charge_ah": 1.5, "swing": 0.5,
        "swing_std": 0.01, "duration_s": 3600.0, "mean_current_a": -1.5, "mean_temperature_c": 21.0 });
    let capacity = json!({ "event": "capacity", "cell": 2, "measured_ah": null, "capacity_ah": 2.41,
        "capacity_std_ah": 0.02, "resistance_ratio": -0.00001, "resistance_ratio_std": 0.1 });
    let losses = json!({ "event": "loss_modes", "cell": 1, "lli": 0.05, "lli_std": 0.01, "lam_ne": 0.02,
        "lam_ne_std": 0.01, "lam_pe": 0.01, "lam_pe_std": 0.01 });
    let model = json!({ "event": "model", "state": "learned", "capacity_ah": 52.1, "capacity_std_ah": 0.4,
        "residual_v": 0.004, "chemistry": null, "is_taken_back": false });
    vec![
        (json!({ "event": "mode", "from": "rest", "to": "discharge" }), "mode: from rest, to discharge"),
        (
            half_cycle,
            "half cycle: cell 1, charge 1.5 Ah, duration 3600 s, mean current -1.5 A, mean temperature 21 °C, mode charge, swing 0.5 ± 0.01",
        ),
        (capacity, "capacity: capacity 2.41 ± 0.02 Ah, cell 3, measured unknown, resistance ratio 0 ± 0.1"),
        (
            losses,
            "loss modes: cell 2, negative electrode lost 0.02 ± 0.01, positive electrode lost 0.01 ± 0.01, lithium lost 0.05 ± 0.01",
        ),
        (
            json!({ "event": "remaining_life", "cell": 1, "cycles": 400.0, "cycles_low": 300.0, "cycles_high": 500.0 }),
            "remaining life: cell 2, cycles 400, cycles high 500, cycles low 300",
        ),
        (
            json!({ "event": "outlook", "remaining_energy_wh": 541.0, "energy_to_full_wh": 60.5 }),
            "outlook: energy to full wh 60.5, remaining energy wh 541",
        ),
        (
            json!({ "event": "recharge_period", "seconds": 5000.0, "normalised_s": 5100.0, "normalised_std_s": 50.0 }),
            "recharge period: normalised 5100 ± 50 s, 5000 s",
        ),
        (alarm, "capacity low raised: cell 3, severity warning, threshold 2.500 Ah, value 2.412 Ah"),
        (pack_alarm, "soc low cleared: severity severe, threshold 10.0 %, value unknown"),
        (
            json!({ "event": "command", "source": "local", "request": { "command": "acknowledge", "rule": null,
            "severity": null, "cell": null }, "changed": 2, "refused": 0 }),
            "command: changed 2, refused 0, request acknowledge, source local",
        ),
        (
            json!({ "event": "command", "source": { "bus": 1 }, "request": { "command": "poll", "standby": true },
            "changed": 0, "refused": 0 }),
            "command: changed 0, refused 0, request poll, standby, source can1",
        ),
        (
            json!({ "event": "bad_command", "bus": 0, "intact": false, "reason": "wrong_checksum" }),
            "bad command: can0, not intact frame, reason wrong checksum",
        ),
        (json!({ "event": "test", "rule": "soc_low", "running": true }), "alarm test started: rule soc low"),
        (
            json!({ "event": "pack_replaced", "capacity_ah": 50.0, "capacity_std_ah": 1.0 }),
            "pack replaced: capacity 50 ± 1 Ah",
        ),
        (
            json!({ "event": "pack_returned", "identity": 4711.0, "capacity_ah": 50.0, "capacity_std_ah": 1.0 }),
            "pack returned: capacity 50 ± 1 Ah, identity 4711",
        ),
        (json!({ "event": "reconfigured", "alarms_ended": 1 }), "reconfigured: alarms ended 1"),
        (
            json!({ "event": "alarm_dropped", "rule": "soc_low", "severity": "info", "cell": null, "active": true,
            "occurrences": 3 }),
            "alarm dropped: active, occurrences 3, rule soc low, severity info",
        ),
        (json!({ "event": "pack_identity", "identity": 4711.0 }), "pack identity: identity 4711"),
        (json!({ "event": "store", "works": false }), "a file cannot be written"),
        (
            json!({ "event": "signal_bad", "channel": { "cell_voltage": 72 }, "fault": "stale" }),
            "signal bad: cell voltage 73, fault stale",
        ),
        (
            json!({ "event": "signal_bad", "channel": "current", "fault": "out_of_range" }),
            "signal bad: current, fault out of range",
        ),
        (
            json!({ "event": "signal_good", "channel": { "temperature": 0 }, "bad_readings": 12 }),
            "signal good: bad readings 12, temperature 1",
        ),
        (
            json!({ "event": "protection", "bus": 0, "id": { "Standard": 1001 }, "status": "wrong_crc", "usable": false, "count": 3 }),
            "protected message fails its check: can0, count 3, message 3E9, status wrong crc",
        ),
        (
            json!({ "event": "flood", "bus": 1, "id": { "Standard": 1001 }, "active": false, "dropped": 120 }),
            "frame rate normal again: can1, dropped 120, message 3E9",
        ),
        (
            json!({ "event": "second_sender", "bus": 0, "id": { "Standard": 1001 }, "active": true, "frames_per_s": 20,
            "expected_per_s": 10.0 }),
            "second sender: can0, expected 10 per s, frames 20 per s, message 3E9",
        ),
        (
            json!({ "event": "own_identifier", "bus": 0, "id": { "Standard": 1001 }, "active": true, "frames": 5 }),
            "another node sends our identifiers: can0, frames 5, message 3E9",
        ),
        (
            json!({ "event": "message_loss", "bus": 0, "id": { "Standard": 2028 }, "fault": "timeout", "lost": 3 }),
            "message loss: can0, fault timeout, message 7EC, lost 3",
        ),
        (
            json!({ "event": "poll", "poll": "silent", "reason": "bus_asleep" }),
            "diagnostic requests: silent, reason bus asleep",
        ),
        (json!({ "event": "poll", "poll": "asking" }), "diagnostic requests: asking"),
        (
            json!({ "event": "poll", "poll": "refused", "id": { "Standard": 2016 }, "service": 34, "identifier": 61840, "code": 49 }),
            "diagnostic requests: code 31, message 7E0, identifier F190, refused, service 22",
        ),
        (json!({ "event": "bus", "bus": 0, "what": { "bus_event": "down" } }), "interface: can0, down"),
        (
            json!({ "event": "bus", "bus": 1, "what": { "bus_event": "dropped", "frames": 3 } }),
            "interface: can1, dropped, frames 3",
        ),
        (
            json!({ "event": "j1939", "what": { "node_event": "claimed", "address": 128 } }),
            "J1939 node: address 128, claimed",
        ),
        (
            json!({ "event": "j1939", "what": { "node_event": "address_lost", "to": name } }),
            "J1939 node: address lost, to 123456789ABCDEF0",
        ),
        (json!({ "event": "bus_asleep", "asleep": true, "seconds": null }), "buses asleep"),
        (json!({ "event": "bus_asleep", "asleep": false, "seconds": 60.0 }), "buses awake: 60 s"),
        (json!({ "event": "gap", "seconds": 4.0 }), "gap: 4 s"),
        (json!({ "event": "time_backwards", "seconds": 2.5 }), "time backwards: 2.5 s"),
        (model, "cell model: capacity 52.1 ± 0.4 Ah, residual 0.004 V, state learned"),
        (finding, "finding: cell 7: loses charge by itself, 10.00 ± 0.10 % of its capacity a day"),
        (json!({ "event": "filter_reset", "cell": 0 }), "filter reset: cell 1"),
        (
            json!({ "event": "trust", "cell": 0, "trusted": false, "mean_nis": 3.25 }),
            "estimate untrusted: cell 1, innovations over expected 3.25",
        ),
    ]
}

#[test]
fn event_words_name_cell_interface_and_state() {
    let mut unseen: BTreeSet<&str> = EventKind::names().iter().copied().collect();
    for (event, expected) in rows() {
        let kind: EventKind = serde_json::from_value(event.clone()).unwrap_or_else(|error| panic!("{event}: {error}"));
        unseen.remove(kind.name());
        assert_eq!(words(&event, &sample(2)), expected);
    }
    assert!(unseen.is_empty(), "no row for {unseen:?}");
    let missed = json!({ "event": "events_missed", "missed": 64, "severity": "warning" });
    assert_eq!(words(&missed, &sample(2)), "events missed: 64, severity warning");
}
