//! Writes the rows of a replay's result files: estimates as CSV, frames as candump lines.

use std::io::{self, Write};

use crate::io::candump::{self, StampDigits};
use crate::monitor::{Estimate, Transmit};

/// Columns of the estimates, in order.
pub const ESTIMATE_COLUMNS: [&str; 17] = [
    "time_s",
    "cell",
    "soc",
    "soc_std",
    "u1_v",
    "u2_v",
    "u3_v",
    "capacity_ah",
    "capacity_std_ah",
    "resistance_ratio",
    "resistance_ratio_std",
    "innovation_v",
    "innovation_std_v",
    "accepted",
    "voltage_v",
    "current_a",
    "temperature_c",
];

pub(super) fn write_estimates_header(out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "{}", ESTIMATE_COLUMNS.join(","))
}

/// Writes one row. Floats have the shortest form that parses to the same value; NaN is an empty field.
pub(super) fn write_estimate(out: &mut impl Write, estimate: &Estimate) -> io::Result<()> {
    let e = estimate;
    let nanos = e.time.nanos();
    let (sign, nanos) = (if nanos < 0 { "-" } else { "" }, nanos.unsigned_abs());
    write!(out, "{sign}{}.{:09},{}", nanos / 1_000_000_000, nanos % 1_000_000_000, e.cell.0)?;
    [e.soc, e.soc_std].into_iter().chain(e.branch_v).try_for_each(|value| write_value(out, value))?;
    let filter = [
        e.capacity_ah,
        e.capacity_std_ah,
        e.resistance_ratio,
        e.resistance_ratio_std,
        e.innovation_v,
        e.innovation_std_v,
    ];
    filter.into_iter().try_for_each(|value| write_value(out, value))?;
    write!(out, ",{}", e.accepted)?;
    let used = e.measured;
    [used.voltage_v, used.current_a, used.temperature_c].into_iter().try_for_each(|value| write_value(out, value))?;
    out.write_all(b"\n")
}

fn write_value(out: &mut impl Write, value: f64) -> io::Result<()> {
    if value.is_nan() { out.write_all(b",") } else { write!(out, ",{value:?}") }
}

pub(super) fn write_frame(out: &mut impl Write, interfaces: &[String], transmit: &Transmit) -> io::Result<()> {
    let interface = interfaces.get(transmit.bus.index()).map_or("unknown", String::as_str);
    candump::write_line(out, transmit.time, StampDigits::Nanos, interface, &transmit.frame)
}
