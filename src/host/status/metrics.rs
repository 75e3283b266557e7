//! Converts the status document to metrics: OpenMetrics 1.0 text, or Prometheus' older text format 0.0.4.
//!
//! * Units are in the names (`_volts`, `_amperes`, `_celsius`, `_ratio`, `_seconds`, `_amperehours`). Counters end with
//!   `_total`. Cells count from 1.
//! * Unknown values are omitted, so a value that is present is valid.
//! * All counters start at 0 when the daemon starts (see `packwatch_uptime_seconds`), as Prometheus expects from a
//!   counter.
//! * If no daemon answers, the only metric is `packwatch_up 0`.

use std::collections::HashSet;
use std::fmt;
use std::fmt::Write as _;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::text::encode;
use prometheus_client::encoding::{DescriptorEncoder, NoLabelSet};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::exemplar::Exemplar;
use prometheus_client::registry::{self, Registry};

use super::document::StatusDocument;
use crate::alarm::Severity;
use crate::can::uds::ControllerCounts;
use crate::io::socket::LinkState;
use crate::monitor::{CellView, PackView, Validity};
use crate::quantity::catalogue::{Part, Presentation, Unit, Values};
use crate::quantity::{CellIndex, Mode};

/// Formats the document as OpenMetrics text, which ends with `# EOF`. `None` = no daemon answers.
pub fn openmetrics(document: Option<StatusDocument>) -> String {
    let mut registry = Registry::with_prefix("packwatch");
    registry.register_collector(Box::new(Metrics(document)));
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = encode(&mut text, &registry);
    text
}

/// Converts OpenMetrics text to Prometheus' older format. In that format, the `HELP` and `TYPE` lines of a counter
/// contain its name with `_total`, and units have no lines.
pub fn prometheus_text(openmetrics: &str) -> String {
    let typed = |wanted: &str| -> HashSet<&str> {
        let types = openmetrics.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.split_once(' '));
        types.filter(|(_, kind)| *kind == wanted).map(|(name, _)| name).collect()
    };
    let (counters, infos) = (typed("counter"), typed("info"));
    let mut text = String::with_capacity(openmetrics.len());
    for line in openmetrics.lines() {
        let mut words = line.splitn(4, ' ');
        match (words.next(), words.next(), words.next(), words.next()) {
            (Some("#"), Some("UNIT" | "EOF"), ..) => {}
            (Some("#"), Some(word @ ("HELP" | "TYPE")), Some(name), Some(rest)) => {
                let suffix = if counters.contains(name) {
                    "_total"
                } else if infos.contains(name) {
                    "_info"
                } else {
                    ""
                };
                let rest = if word == "TYPE" && rest == "info" { "gauge" } else { rest };
                let _ = writeln!(text, "# {word} {name}{suffix} {rest}");
            }
            _ => {
                text.push_str(line);
                text.push('\n');
            }
        }
    }
    text
}

#[derive(Debug)]
struct Metrics(Option<StatusDocument>);

type Labels = Vec<(&'static str, String)>;

/// Writes metric families. Samples with unknown values are omitted.
struct Families<'a>(DescriptorEncoder<'a>);

impl Families<'_> {
    fn gauge(
        &mut self,
        name: &str,
        unit: &str,
        help: &str,
        samples: impl IntoIterator<Item = (Labels, Option<f64>)>,
    ) -> fmt::Result {
        let known = samples.into_iter().filter_map(|(labels, value)| Some((labels, value?)));
        let mut known = known.peekable();
        if known.peek().is_none() {
            return Ok(());
        }
        let unit = (!unit.is_empty()).then(|| registry::Unit::Other(unit.to_owned()));
        let mut family = self.0.encode_descriptor(name, help, unit.as_ref(), MetricType::Gauge)?;
        for (labels, value) in known {
            if labels.is_empty() {
                family.encode_gauge(&value)?;
            } else {
                family.encode_family(&labels)?.encode_gauge(&value)?;
            }
        }
        Ok(())
    }

    fn counter(&mut self, name: &str, help: &str, samples: impl IntoIterator<Item = (Labels, u64)>) -> fmt::Result {
        let mut samples = samples.into_iter().peekable();
        if samples.peek().is_none() {
            return Ok(());
        }
        let mut family = self.0.encode_descriptor(name, help, None, MetricType::Counter)?;
        let exemplar: Option<&Exemplar<NoLabelSet, u64>> = None;
        for (labels, value) in samples {
            if labels.is_empty() {
                family.encode_counter(&value, exemplar)?;
            } else {
                family.encode_family(&labels)?.encode_counter(&value, exemplar)?;
            }
        }
        Ok(())
    }

    fn info(&mut self, name: &str, help: &str, labels: &Labels) -> fmt::Result {
        self.0.encode_descriptor(name, help, None, MetricType::Info)?.encode_info(labels)
    }
}

fn one<T>(value: T) -> [(Labels, T); 1] {
    [(Labels::new(), value)]
}

fn label(name: &'static str, value: impl Into<String>) -> Labels {
    vec![(name, value.into())]
}

/// Converts true to 1 and false to 0.
fn flag(value: bool) -> Option<f64> {
    Some(f64::from(u8::from(value)))
}

impl Collector for Metrics {
    fn encode(&self, encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let mut families = Families(encoder);
        families.gauge("up", "", "Whether the daemon reports its status", one(flag(self.0.is_some())))?;
        let Some(document) = &self.0 else { return Ok(()) };
        program(&mut families, document)?;
        interfaces(&mut families, document)?;
        pack(&mut families, &document.pack)?;
        cells(&mut families, &document.cells)?;
        alarms(&mut families, document)?;
        readings(&mut families, document)?;
        core(&mut families, document)?;
        service(&mut families, document)?;
        store(&mut families, document)
    }
}

fn program(families: &mut Families<'_>, document: &StatusDocument) -> fmt::Result {
    families.info("build", "The program", &label("version", document.program_version.clone()))?;
    if let Some(config) = &document.config {
        families.info("config", "The daemon's configuration", &label("sha256", config.sha256.clone()))?;
    }
    if document.vehicle.is_stated() {
        families.info("vehicle", "The vehicle and its pack, as configured", &document.vehicle.labels())?;
    }
    families.gauge("uptime", "seconds", "Time since the daemon's start", one(Some(document.uptime_s)))?;
    let seconds = |time: crate::quantity::Timestamp| time.nanos() as f64 / 1e9;
    let written = one(Some(seconds(document.wall_time)));
    families.gauge("status_time", "seconds", "Time of the status, on the computer's clock", written)?;
    let states = [
        (Validity::Unavailable, "unavailable"),
        (Validity::Valid, "valid"),
        (Validity::Degraded, "degraded"),
        (Validity::Untrusted, "untrusted"),
    ];
    let states = states.map(|(state, name)| (label("state", name), flag(document.state == state)));
    families.gauge("validity", "", "Validity of the estimates, 1 for the current state", states)?;
    let modes =
        [(Mode::Unknown, "unknown"), (Mode::Charge, "charge"), (Mode::Rest, "rest"), (Mode::Discharge, "discharge")];
    let modes = modes.map(|(mode, name)| (label("mode", name), flag(document.pack.mode == mode)));
    families.gauge("mode", "", "Charge, rest or discharge, 1 for the current mode", modes)
}

fn interfaces(families: &mut Families<'_>, document: &StatusDocument) -> fmt::Result {
    let all = &document.interfaces;
    let named = |name: &str| label("interface", name);
    let up = |state| match state {
        LinkState::Unknown => None,
        state => flag(state == LinkState::Up),
    };
    let states = all.iter().map(|it| (named(&it.name), up(it.state)));
    families.gauge("interface_up", "", "Whether the interface is up", states)?;
    let mut counts = |name, help, of: fn(&super::document::InterfaceStatus) -> u64| {
        families.counter(name, help, all.iter().map(|it| (named(&it.name), of(it))))
    };
    counts("interface_reconnects", "Times the interface came up again", |it| it.reconnects)?;
    counts("interface_received_frames", "Frames received", |it| it.received.frames)?;
    counts("interface_error_frames", "Error frames", |it| it.received.error_frames)?;
    counts("interface_bus_offs", "Error frames that report bus-off", |it| it.received.bus_offs)?;
    counts("interface_sent_frames", "Frames sent", |it| it.link.sent)?;
    let with = |name: &str, reason: &str| vec![("interface", name.to_owned()), ("reason", reason.to_owned())];
    let dropped = all.iter().flat_map(|it| {
        let reasons =
            [("kernel", it.link.kernel_dropped), ("queue", it.link.queue_dropped), ("malformed", it.link.malformed)];
        reasons.map(|(reason, count)| (with(&it.name, reason), count))
    });
    families.counter("interface_dropped_frames", "Received frames that were lost", dropped)?;
    let unsent = all.iter().flat_map(|it| {
        let reasons = [("queue", it.link.send_queue_full), ("kernel", it.link.send_failed)];
        reasons.map(|(reason, count)| (with(&it.name, reason), count))
    });
    families.counter("interface_unsent_frames", "Frames that could not be sent", unsent)?;
    let flooded = document.floods.iter().map(|flood| (message(&flood.interface, &flood.id), flood.dropped));
    families.counter("message_flood_dropped_frames", "Frames of a message beyond the accepted rate", flooded)?;
    let controllers = document.controllers.iter().flat_map(|it| {
        let ControllerCounts { read, other, refused, pending, unasked, .. } = it.counts;
        let outcomes =
            [("read", read), ("other", other), ("refused", refused), ("pending", pending), ("unasked", unasked)];
        outcomes.map(|(outcome, count)| {
            let mut labels = message(&it.interface, &it.id);
            labels.push(("outcome", outcome.to_owned()));
            (labels, count)
        })
    });
    families.counter("diagnostic_answers", "Diagnostic answers of a controller by outcome", controllers)?;
    let lost = document.controllers.iter().map(|it| (message(&it.interface, &it.id), it.counts.lost_in_all()));
    families.counter("diagnostic_lost_messages", "Diagnostic messages of a controller that were lost", lost)?;
    let checks = document.protection.iter().flat_map(|protected| {
        protected.checks.iter().map(|check| {
            let mut labels = message(&protected.interface, &protected.id);
            labels.push(("status", check.status.clone()));
            (labels, check.count)
        })
    });
    families.counter("message_protection_checks", "End-to-end checks of a message by their status", checks)
}

fn message(interface: &str, id: &str) -> Labels {
    vec![("interface", interface.to_owned()), ("id", id.to_owned())]
}

fn pack(families: &mut Families<'_>, pack: &PackView) -> fmt::Result {
    let number = |cell: Option<CellIndex>| cell.map(|cell| f64::from(cell.0) + 1.0);
    let state = pack.model_state.map(|state| f64::from(state.code()));
    let rows = [
        ("pack_model_state", "Model of the cells: 0 prior, 1 learning, 2 learned, 3 unfit, 4 given", state),
        ("pack_limiting_cell", "Number of the cell that ends a discharge", number(pack.limiting_cell)),
        ("pack_weakest_cell", "Number of the cell with the least capacity", number(pack.weakest_cell)),
        ("pack_shortest_lived_cell", "Number of the cell whose life ends first", number(pack.shortest_lived_cell)),
    ];
    rows.into_iter().try_for_each(|(name, help, value)| families.gauge(name, "", help, one(value)))?;
    quantities(families, "pack", &one(&pack.values))
}

fn cells(families: &mut Families<'_>, cells: &[CellView]) -> fmt::Result {
    let number = |cell: &CellView| label("cell", (u32::from(cell.cell.0) + 1).to_string());
    let trusted = cells.iter().map(|cell| (number(cell), cell.trusted.and_then(flag)));
    families.gauge("cell_trusted", "", "Whether the filter is consistent", trusted)?;
    let values: Vec<_> = cells.iter().map(|cell| (number(cell), &cell.values)).collect();
    quantities(families, "cell", &values)
}

/// Writes the quantities of the catalogue and their standard deviations.
fn quantities<const IS_PACK: bool>(
    families: &mut Families<'_>,
    owner: &str,
    values: &[(Labels, &Values<IS_PACK>)],
) -> fmt::Result {
    for (row, Presentation { about, .. }) in Values::<IS_PACK>::rows() {
        let (unit, factor) = metric_unit(row.unit);
        let sign = if row.unit == Unit::Amperes { ", positive when discharging" } else { "" };
        for (part, _) in row.parts() {
            let samples = values
                .iter()
                .map(|(labels, values)| (labels.clone(), values.part(row.quantity, part).map(|value| factor * value)));
            let (ending, help) = match part {
                Part::Mean => ("", format!("{about}{sign}")),
                Part::Std => ("_std", format!("Standard deviation: {about}")),
            };
            families.gauge(&format!("{owner}_{}{ending}", row.metric), unit, &help, samples)?;
        }
    }
    Ok(())
}

/// The unit in a metric's name, and the factor that converts to this unit.
const fn metric_unit(unit: Unit) -> (&'static str, f64) {
    match unit {
        Unit::Level | Unit::Fraction | Unit::Ratio => ("ratio", 1.0),
        Unit::Volts => ("volts", 1.0),
        Unit::Amperes => ("amperes", 1.0),
        Unit::Celsius => ("celsius", 1.0),
        Unit::AmpereHours => ("amperehours", 1.0),
        Unit::WattHours => ("joules", 3600.0),
        Unit::Watts => ("watts", 1.0),
        Unit::Seconds => ("seconds", 1.0),
        Unit::Days => ("seconds", 86_400.0),
        Unit::Cycles | Unit::Count => ("", 1.0),
    }
}

fn alarms(families: &mut Families<'_>, document: &StatusDocument) -> fmt::Result {
    let alarms = &document.alarms;
    families.gauge("alarms_active", "", "Alarms that are raised", one(Some(alarms.raised as f64)))?;
    families.gauge("alarm_thresholds", "", "Thresholds configured", one(Some(alarms.thresholds as f64)))?;
    let unknown = one(Some(alarms.unknown.len() as f64));
    families.gauge("alarm_thresholds_unknown", "", "Thresholds with alarms that cannot be evaluated", unknown)?;
    let active = alarms.list.iter().filter(|alarm| alarm.state.is_raised()).map(|alarm| {
        let cell = alarm.cell.map_or_else(|| "pack".to_owned(), |cell| (u32::from(cell.0) + 1).to_string());
        let (rule, severity) = (alarm.rule.name().to_owned(), alarm.severity.name().to_owned());
        (vec![("rule", rule), ("severity", severity), ("cell", cell)], Some(1.0))
    });
    families.gauge("alarm_active", "", "An alarm that is raised", active)?;
    let raised = Severity::ALL
        .map(|severity| (label("severity", severity.name()), document.counters.core.alarms_raised.get(severity)));
    families.counter("alarms_raised", "Times an alarm was raised", raised)
}

fn readings(families: &mut Families<'_>, document: &StatusDocument) -> fmt::Result {
    let readings = &document.counters.readings;
    families.counter("readings_accepted", "Readings used", one(readings.accepted))?;
    let rejected = readings.rejected().map(|(reason, count)| (label("reason", reason), count));
    families.counter("readings_rejected", "Readings not used", rejected)?;
    families.counter("readings_unused", "Readings without a use", one(readings.unused))?;
    families.counter("signals_stale", "Times a signal became too old", one(readings.stale))?;
    let levels = one(readings.levels_believed);
    families.counter("signal_levels_believed", "Steps of a signal rejected at first, then accepted", levels)
}

fn core(families: &mut Families<'_>, document: &StatusDocument) -> fmt::Result {
    let core = &document.counters.core;
    let rows = [
        ("estimator_voltages_used", "Voltage readings that updated an estimate", core.voltages.used),
        ("estimator_voltages_gated", "Voltage readings beyond the filter's gate", core.voltages.gated),
        ("estimator_voltages_unmatched", "Voltage readings without a current", core.voltages.without_current),
        ("estimator_resets", "Filters restarted from their voltage", core.filter_resets),
        ("estimator_trust_lost", "Times an estimate became untrusted", core.trust_lost),
        ("gaps", "Gaps without a measurement", core.gaps),
        ("time_backwards", "Inputs with a time before an earlier input's", document.counters.time_backwards),
        ("mode_changes", "Changes between charge, rest and discharge", core.mode_changes),
        ("half_cycles", "Half-cycles, per cell", core.learning.half_cycles),
        ("capacity_updates", "Runs of a capacity filter", core.learning.capacity_updates),
        ("capacity_measurements", "Runs of a capacity filter with a measurement", core.learning.capacity_measurements),
        ("recharge_periods", "Recharge periods recorded", core.learning.recharge_periods),
        ("commands", "Commands executed", core.commands),
        ("bad_commands", "Command frames not executed", core.bad_commands),
        ("packs_replaced", "Times the pack was replaced", core.packs_replaced),
        ("state_restores", "Times a stored state was restored", core.restores),
        ("file_failures", "Times a file could no longer be written", core.store_failures),
    ];
    rows.into_iter().try_for_each(|(name, help, count)| families.counter(name, help, one(count)))
}

fn service(families: &mut Families<'_>, document: &StatusDocument) -> fmt::Result {
    let (service, clients) = (&document.counters.service, &document.counters.clients);
    let rows = [
        ("ticks", "Ticks of the loop", service.ticks),
        ("missed_deadlines", "Ticks more than a period late", service.missed_deadlines),
        ("reloads", "Configurations applied while running", service.reloads),
        ("reloads_refused", "Configurations rejected while running", service.reloads_refused),
        ("status_skipped", "Status documents skipped", service.documents_skipped),
        ("status_clients_served", "Clients of the status sockets", clients.served),
        ("status_clients_refused", "Clients rejected: too many at once", clients.refused),
        ("status_clients_dropped", "Clients that did not read in time", clients.dropped),
    ];
    rows.into_iter().try_for_each(|(name, help, count)| families.counter(name, help, one(count)))?;
    let lateness = one(Some(service.worst_lateness_s));
    families.gauge("tick_lateness_max", "seconds", "Greatest lateness of a tick", lateness)?;
    let latency = &document.latency;
    let buckets: Vec<(f64, u64)> =
        latency.buckets.iter().map(|bucket| (bucket.le_s.unwrap_or(f64::INFINITY), bucket.frames)).collect();
    let unit = registry::Unit::Seconds;
    let help = "Time from the kernel's receive stamp of a frame to its estimate";
    let mut family = families.0.encode_descriptor("frame_to_estimate", help, Some(&unit), MetricType::Histogram)?;
    family.encode_histogram::<NoLabelSet>(latency.sum_s, latency.frames, &buckets, None)
}

fn store(families: &mut Families<'_>, document: &StatusDocument) -> fmt::Result {
    let Some(store) = &document.store else { return Ok(()) };
    families.gauge("store_works", "", "Whether the store can be written", one(store.works.and_then(flag)))?;
    families.counter("store_commits", "Commits done", one(store.commits))?;
    families.counter("store_failures", "Commits that failed", one(store.failures))?;
    families.counter("store_late", "Results announced before they were stored", one(store.late))?;
    let size = one(store.file_bytes.map(|bytes| bytes as f64));
    families.gauge("store_size", "bytes", "Size of the store's files", size)
}

#[cfg(test)]
mod tests;
