//! Creates the rows about the use of a pack: time and events beyond limits, C-rates, depth of discharge, fast charges,
//! rest at a high state of charge.

use super::format;
use crate::health::UseRecord;
use crate::health::use_record::LimitUse;

/// Returns the rows of the limits: name, time beyond the limit, number of events, time with a known value, time with an
/// unknown value, extreme value. If no limit was configured or no value was known, columns two to four have no numbers.
pub(super) fn limits(record: &UseRecord) -> impl Iterator<Item = Vec<String>> {
    let UseRecord { temperature_c, voltage_v, current_a, .. } = record;
    let charge_a = current_a.lowest.map(|lowest_a| (-lowest_a).max(0.0));
    let discharge_a = current_a.highest.map(|highest_a| highest_a.max(0.0));
    let rows = [
        ("Temperature below its limit", temperature_c.below, temperature_c.unknown_s, temperature_c.lowest, 1, "°C"),
        ("Temperature above its limit", temperature_c.above, temperature_c.unknown_s, temperature_c.highest, 1, "°C"),
        ("Cell voltage below its limit", voltage_v.below, voltage_v.unknown_s, voltage_v.lowest, 3, "V"),
        ("Cell voltage above its limit", voltage_v.above, voltage_v.unknown_s, voltage_v.highest, 3, "V"),
        ("Charging current above its limit (per cell)", current_a.below, current_a.unknown_s, charge_a, 1, "A"),
        ("Discharging current above its limit (per cell)", current_a.above, current_a.unknown_s, discharge_a, 1, "A"),
    ];
    rows.into_iter().map(|(name, LimitUse { known_s, beyond_s, events, .. }, unknown_s, extreme, digits, unit)| {
        let [beyond, events, known] = match known_s > 0.0 {
            true => [format::length(beyond_s), events.to_string(), format::length(known_s)],
            false => ["-", "-", "no limit, or unknown"].map(str::to_owned),
        };
        let extreme = extreme.map_or_else(
            || "unknown".to_owned(),
            |extreme| format!("{} {unit}", format::without_minus_zero(format!("{extreme:.digits$}"))),
        );
        vec![name.to_owned(), beyond, events, known, format::length(unknown_s), extreme]
    })
}

pub(super) fn rows(record: &UseRecord) -> Vec<(String, String)> {
    let UseRecord { c_rate, half_cycles, rest, .. } = record;
    let times = |seconds: &[f64; 5]| {
        let names = ["0 to 0.5 C", "0.5 to 1 C", "1 to 2 C", "2 to 3 C", "above 3 C"].into_iter();
        let times = names.zip(seconds).map(|(name, seconds)| format!("{name}: {}", format::length(*seconds)));
        times.collect::<Vec<_>>().join(", ")
    };
    let depths = half_cycles.discharges.iter().enumerate().filter(|(_, count)| **count > 0);
    let depths = depths.map(|(tenth, count)| match tenth {
        9 => format!("above 90 %: {count}"),
        tenth => format!("{} to {} %: {count}", 10 * tenth, 10 * (tenth + 1)),
    });
    let depths = depths.collect::<Vec<_>>().join(", ");
    let rows = [
        ("Charging by C-rate", times(&c_rate.charge_s)),
        ("Discharging by C-rate", times(&c_rate.discharge_s)),
        ("Discharges by depth", if depths.is_empty() { "none".to_owned() } else { depths }),
        ("Charges, of these above 1 C", format!("{}, {}", half_cycles.charges, half_cycles.fast_charges)),
        ("Charges and discharges with a doubtful current", half_cycles.unknown.to_string()),
        (
            "Rest with a state of charge above 80 %, above 90 %",
            format!("{}, {}", format::length(rest.above_80_s), format::length(rest.above_90_s)),
        ),
        (
            "Rest with a known, an unknown state of charge",
            format!("{}, {}", format::length(rest.known_s), format::length(rest.unknown_s)),
        ),
    ];
    rows.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}
