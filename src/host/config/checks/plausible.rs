//! Checks for settings that parse but cannot be intended. Examples: a signal extends beyond its message, two signals
//! share bits, a unit is wrong, a range is empty, the capacity belongs to another cell.
//!
//! In: the tables of the configuration, the signals that were found in the DBC files, the cell model. Out: faults for
//! certain errors, warnings for unlikely values. If the unit in the DBC contradicts a configured `scale` or `offset`,
//! the result is only a warning.

use super::cells::Module;
use super::signals::{self, ResolvedSignal};
use crate::can::dbc::{MuxCondition, Signal};
use crate::can::signal::{ByteOrder, SignalLayout};
use crate::can::unit::{Quantity, SignalUnit};
use crate::cell::CellModel;
use crate::config::document::TablePlace;
use crate::config::schema::RawTables;
use crate::quantity::{Channel, bounds};
use crate::sample::Limits;

/// Two cells count as different if the ratio of their rated capacities (larger over smaller) is at least this number.
const OTHER_CELL: f64 = 3.0;

pub(crate) fn signals(raw: &RawTables, found: &[ResolvedSignal<'_>], model: Option<&CellModel>) {
    let series = raw.pack.as_ref().map_or(1, |pack| pack.cells);
    for (place, signals) in by_table(raw, found) {
        unreadable(place, &signals);
        ends(place, &signals);
        let before = place.faults.len();
        units(place, &signals, (model, series));
        if place.faults.len() == before {
            reach(place, &signals, (model, series));
        }
    }
    overlaps(raw, found);
}

/// Range of the values that can occur on a channel, in the channel's unit. A signal must be able to encode at least a
/// part of this range. `None` = the channel is not checked.
fn needed_values(channel: Channel, (model, series): (Option<&CellModel>, u16)) -> Option<(f64, f64)> {
    // Without a model, the range covers any lithium-ion cell.
    let (low, high) = model.map_or((1.2, 4.6), |model| (model.voltage_min_v, model.voltage_max_v));
    match channel {
        Channel::CellVoltage(_) => Some((low, high)),
        Channel::PackVoltage => Some((low * f64::from(series), high * f64::from(series))),
        Channel::Temperature(_) => Some((-40.0, 80.0)),
        _ => None,
    }
}

/// Returns the smallest and largest value that a signal's bits can encode, after `scale` and `offset`.
fn held(resolved: &ResolvedSignal<'_>, scale: f64, offset: f64) -> (f64, f64) {
    let (low, high) = resolved.signal.layout.extent();
    (low * scale + offset, high * scale + offset)
}

/// Reports the first signal of a table whose bits cannot encode any value that occurs in the pack.
fn reach(place: &TablePlace, signals: &[&ResolvedSignal<'_>], pack: (Option<&CellModel>, u16)) {
    let beyond = signals.iter().filter(|resolved| resolved.binding().is_ok()).find_map(|resolved| {
        let needed = needed_values(resolved.channel, pack)?;
        let (low, high) = held(resolved, resolved.scale, resolved.offset);
        (low > needed.1 || high < needed.0).then_some((resolved, needed, (low, high)))
    });
    let Some((resolved, (from, to), (low, high))) = beyond else { return };
    let unit = needed(resolved.channel).map_or("", |(_, unit)| unit);
    let (name, low, high) = (name(resolved, resolved.signal), digits(low, 3), digits(high, 3));
    let what = format!(
        "{name} can carry only {low} to {high} {unit} after factor and scale, must overlap {} to {} {unit}",
        digits(from, 3),
        digits(to, 3)
    );
    place.fault(if place.has("scale") { "scale" } else { "signal" }, &what);
}

fn by_table<'r, 'd>(
    raw: &'r RawTables,
    found: &'r [ResolvedSignal<'d>],
) -> Vec<(&'r TablePlace, Vec<&'r ResolvedSignal<'d>>)> {
    let mut tables: Vec<(&TablePlace, Vec<&ResolvedSignal<'_>>)> = Vec::new();
    for resolved in found {
        let Some(source) = raw.source(resolved.channel) else { continue };
        match tables.iter_mut().find(|(place, _)| place.path == source.place.path) {
            Some((_, signals)) => signals.push(resolved),
            None => tables.push((source.place, vec![resolved])),
        }
    }
    tables
}

/// Full name `Message.Signal` of a signal in the resolved signal's message.
fn name(resolved: &ResolvedSignal<'_>, signal: &Signal) -> String {
    format!("{}.{}", resolved.message.name, signal.name)
}

/// Reports signals with an invalid layout or range: one fault per table and reason.
fn unreadable(place: &TablePlace, signals: &[&ResolvedSignal<'_>]) {
    let mut reasons: Vec<(String, &ResolvedSignal<'_>, usize)> = Vec::new();
    for resolved in signals {
        let Err(reason) = resolved.binding() else { continue };
        let reason = reason.to_string();
        match reasons.iter_mut().find(|(known, ..)| *known == reason) {
            Some((.., others)) => *others += 1,
            None => reasons.push((reason, resolved, 0)),
        }
    }
    for (reason, first, others) in reasons {
        let (name, file) = (name(first, first.signal), first.file);
        let others = match others {
            0 => String::new(),
            1 => " and 1 other".to_owned(),
            others => format!(" and {others} others"),
        };
        place.fault("signal", format!("{name}{others} in {file} cannot be read: {reason}"));
    }
}

/// Reports signals, and multiplexors of these signals, that extend beyond their message. Reports one fault per table.
fn ends(place: &TablePlace, signals: &[&ResolvedSignal<'_>]) {
    // The length of a diagnostic answer is unknown until the answer arrives.
    let in_frames = signals.iter().filter(|resolved| resolved.answer.is_none());
    let parts = in_frames.flat_map(|resolved| {
        let selectors = selectors(resolved).map(|(_, selector)| selector);
        selectors.chain([resolved.signal]).map(|signal| (*resolved, signal))
    });
    let is_beyond = |(resolved, signal): &(&ResolvedSignal<'_>, &Signal)| {
        signal.layout.end_byte() > u32::from(resolved.message.len_bytes)
    };
    let mut beyond: Vec<(&ResolvedSignal<'_>, &Signal)> = parts.filter(is_beyond).collect();
    beyond.dedup_by(|a, b| std::ptr::eq(a.1, b.1));
    let Some(&(resolved, signal)) = beyond.first() else { return };
    let others = match beyond.len() - 1 {
        0 => " ends".to_owned(),
        1 => " and 1 other end".to_owned(),
        others => format!(" and {others} others end"),
    };
    let whose = if beyond.len() == 1 { "its" } else { "their" };
    let (byte, len, file) = (signal.layout.end_byte(), resolved.message.len_bytes, resolved.file);
    let mut what = format!(
        "{}{others} in byte {byte} of {whose} message, must end within the {len} bytes stated in {file}",
        name(resolved, signal)
    );
    if let Some((order, layout)) = other_order(&signal.layout)
        && layout.end_byte() <= u32::from(len)
    {
        what += &format!(
            "; with the other byte order ({order}) {} would fit",
            if beyond.len() == 1 { "it" } else { "they" }
        );
    }
    place.fault("signal", &what);
}

/// Returns the layout with the other byte order, and the DBC notation of that order; `None` for a one-bit signal.
fn other_order(layout: &SignalLayout) -> Option<(&'static str, SignalLayout)> {
    let (order, byte_order) = match layout.byte_order {
        ByteOrder::LittleEndian => ("@0", ByteOrder::BigEndian),
        ByteOrder::BigEndian => ("@1", ByteOrder::LittleEndian),
    };
    (layout.length_bits > 1).then_some((order, SignalLayout { byte_order, ..*layout }))
}

/// Returns the multiplexors that a signal depends on, each with the condition that its value must meet.
fn selectors<'r>(resolved: &'r ResolvedSignal<'_>) -> impl Iterator<Item = (&'r MuxCondition, &'r Signal)> {
    let conditions = resolved.signal.conditions.iter();
    conditions.filter_map(|condition| Some((condition, resolved.message.signals.get(condition.selector)?)))
}

/// Reports inputs whose bits in a message overlap with another input or with a multiplexor: one fault per table.
fn overlaps(raw: &RawTables, found: &[ResolvedSignal<'_>]) {
    for (place, signals) in by_table(raw, found) {
        let mut pairs: Vec<(String, String)> = Vec::new();
        for resolved in signals {
            let selectors = selectors(resolved).map(|(_, selector)| selector);
            let earlier = found.iter().take_while(|other| !std::ptr::eq(*other, resolved));
            let beside = earlier.filter(|other| is_beside(other, resolved) && has_bits_of(other, resolved));
            let selectors = selectors.filter(|other| other.layout.overlaps(&resolved.signal.layout));
            let shared = selectors.chain(beside.map(|other| other.signal));
            pairs.extend(shared.map(|other| (name(resolved, other), name(resolved, resolved.signal))));
        }
        let Some((first, second)) = pairs.first() else { continue };
        let more = match pairs.len() - 1 {
            0 => String::new(),
            1 => " (and 1 other pair)".to_owned(),
            more => format!(" (and {more} other pairs)"),
        };
        place.fault("signal", format!("{first} and {second}{more} share bits of one message, must not overlap"));
    }
}

/// Whether two inputs are different signals that the same frame can contain.
fn is_beside(a: &ResolvedSignal<'_>, b: &ResolvedSignal<'_>) -> bool {
    let is_other_page = |condition: &MuxCondition| {
        let same = b.signal.conditions.iter().find(|other| other.selector == condition.selector);
        same.is_some_and(|other| {
            !condition.ranges.iter().any(|range| other.ranges.iter().any(|o| ranges_overlap(*range, *o)))
        })
    };
    a.bus == b.bus
        && std::ptr::eq(a.message, b.message)
        && !std::ptr::eq(a.signal, b.signal)
        && !a.signal.conditions.iter().any(is_other_page)
}

/// Whether two inputs of one message share bits. In a diagnostic answer, a signal's layout counts from the signal's own
/// first byte, so the position of this byte in the answer is added.
fn has_bits_of(a: &ResolvedSignal<'_>, b: &ResolvedSignal<'_>) -> bool {
    let bits = |resolved: &ResolvedSignal<'_>| {
        let first = resolved.answer?.bit(&resolved.signal.layout);
        Some(first..first + usize::from(resolved.signal.layout.length_bits))
    };
    match (bits(a), bits(b)) {
        (Some(a), Some(b)) => a.start < b.end && b.start < a.end,
        _ => a.signal.layout.overlaps(&b.signal.layout),
    }
}

fn ranges_overlap(a: (u64, u64), b: (u64, u64)) -> bool {
    a.0 <= b.1 && b.0 <= a.1
}

/// Returns the quantity that a channel needs, and its unit; `None` = any quantity.
fn needed(channel: Channel) -> Option<(Quantity, &'static str)> {
    match channel {
        Channel::Current => Some((Quantity::Current, "A")),
        Channel::PackVoltage | Channel::CellVoltage(_) | Channel::SupplyVoltage => Some((Quantity::Voltage, "V")),
        Channel::Temperature(_) => Some((Quantity::Temperature, "degrees C")),
        Channel::ReportedSoc | Channel::ReportedSoh => Some((Quantity::PERCENTAGE, "% or a fraction")),
        Channel::Balancing(_) | Channel::PackIdentity | Channel::CurrentDirection | Channel::Contactor => None,
    }
}

/// Reports DBC units that differ from the input's unit; each unit is reported once per table.
fn units(place: &TablePlace, signals: &[&ResolvedSignal<'_>], pack: (Option<&CellModel>, u16)) {
    let mut seen: Vec<&str> = Vec::new();
    for resolved in signals {
        let text = resolved.signal.unit.as_str();
        let (Some((quantity, wanted)), Some(unit)) = (needed(resolved.channel), SignalUnit::parse(text)) else {
            continue;
        };
        if seen.contains(&text) {
            continue;
        }
        seen.push(text);
        let name = name(resolved, resolved.signal);
        if unit.quantity == Quantity::PERCENTAGE && quantity == unit.quantity {
            continue; // the scale of a percentage defaults to 0.01
        }
        if unit.quantity == quantity {
            let is_held = needed_values(resolved.channel, pack).is_none_or(|(low, high)| {
                let held = held(resolved, unit.factor, unit.offset);
                held.0 <= high && held.1 >= low
            });
            conversion(place, (resolved, unit, is_held), (&name, wanted));
        } else {
            other_quantity(place, unit.quantity, (&name, text, wanted));
        }
    }
}

fn is_converted(place: &TablePlace) -> bool {
    place.has("scale") || place.has("offset")
}

fn other_quantity(place: &TablePlace, found: Quantity, (name, unit, wanted): (&str, &str, &str)) {
    let found = match found {
        Quantity::Current => "a current",
        Quantity::Voltage => "a voltage",
        Quantity::Temperature => "a temperature",
        Quantity::Other(quantity) => quantity,
    };
    if is_converted(place) {
        let key = if place.has("scale") { "scale" } else { "offset" };
        place.warn(key, format!("the unit of {name} is {unit:?}, {found}, where {wanted} is expected"));
    } else {
        let what =
            format!("the unit of {name} is {unit:?}, {found}, must be {wanted} (set scale = 1.0 if the DBC is wrong)");
        place.fault("signal", &what);
    }
}

/// Checks that `scale` and `offset` convert the DBC's unit to the input's unit. `is_held` states whether the signal's
/// bits can encode a plausible value in the DBC's unit. If they cannot, the DBC's unit is wrong.
fn conversion(
    place: &TablePlace,
    (resolved, unit, is_held): (&ResolvedSignal<'_>, SignalUnit, bool),
    (name, wanted): (&str, &str),
) {
    let (scale, offset) = (resolved.scale.abs(), resolved.offset);
    // A scale within 10 % and an offset within 20 degrees C count as a calibration of the sensor.
    let is_scale = (scale / unit.factor - 1.0).abs() <= 0.1;
    let is_offset = unit.quantity != Quantity::Temperature || (offset - unit.offset).abs() <= 20.0;
    if is_scale && is_offset {
        return;
    }
    let (key, needed) = if is_scale { ("offset", unit.offset) } else { ("scale", unit.factor) };
    let (needed, text) = (toml(needed), &resolved.signal.unit);
    let beside =
        if is_scale || unit.offset == 0.0 { String::new() } else { format!(", with offset = {}", toml(unit.offset)) };
    if !is_held && !is_converted(place) {
        let what = format!(
            "the unit of {name} is {text:?}, but its bits cannot carry a plausible value in that unit: read as {wanted}"
        );
        place.warn("signal", &what);
    } else if is_converted(place) {
        place.warn(key, format!("should be {needed}{beside} according to the unit {text:?} of {name}"));
    } else {
        let unscaled = if key == "offset" { "0.0" } else { "1.0" };
        let what = format!(
            "must be {needed}{beside}: the unit of {name} is {text:?} (set {unscaled} if the DBC is wrong and the unit is {wanted})"
        );
        place.fault(key, &what);
    }
}

/// A float in TOML notation, rounded to ten digits.
fn toml(value: f64) -> String {
    format!("{:?}", digits(value, 9))
}

/// Rounds to 1 + `decimals` significant digits.
fn digits(value: f64, decimals: usize) -> f64 {
    format!("{value:.decimals$e}").parse().unwrap_or(value)
}

/// The allowed range of one kind of reading, and where its limits are configured.
struct AllowedRange<'a> {
    place: &'a TablePlace,
    keys: [&'static str; 2],
    limits: Limits,
    /// Limits stated by the DBC, converted with `scale`.
    dbc: (f64, f64),
    unit: &'static str,
    /// Input whose DBC states the range.
    input: Option<&'a TablePlace>,
}

/// Reports a range of plausible readings that contains no value, and a voltage range that contains no voltage of the
/// cell model.
pub(crate) fn ranges(raw: &RawTables, found: &[ResolvedSignal<'_>], model: Option<&CellModel>) {
    let Some(pack) = &raw.pack else { return };
    let readable: Vec<ResolvedSignal<'_>> = found.iter().filter(|input| input.binding().is_ok()).cloned().collect();
    let dbc = signals::ranges(&readable, pack.cells);
    let input = |belongs: fn(Channel) -> bool| {
        let first = found.iter().find(|resolved| belongs(resolved.channel))?;
        raw.source(first.channel).map(|source| source.place)
    };
    if let Some(keys) = &raw.current_limits {
        let (limits, dbc) = (keys.config(dbc.current_a), dbc.current_a);
        let input = input(|channel| channel == Channel::Current);
        let keys_of_range = ["max_charge_a", "max_discharge_a"];
        AllowedRange { place: &keys.place, keys: keys_of_range, limits, dbc, unit: "A", input }.check();
    }
    if let Some(keys) = &raw.temperature_limits {
        let (limits, dbc) = (keys.config(dbc.temperature_c), dbc.temperature_c);
        let input = input(|channel| matches!(channel, Channel::Temperature(_)));
        AllowedRange { place: &keys.place, keys: ["min_c", "max_c"], limits, dbc, unit: "degrees C", input }.check();
    }
    if let (Some(keys), Some(model)) = (&raw.voltage_limits, model) {
        let (limits, dbc) = (keys.config(model, dbc.voltage_v), dbc.voltage_v);
        let input = input(|channel| matches!(channel, Channel::CellVoltage(_) | Channel::PackVoltage));
        let range = AllowedRange { place: &keys.place, keys: ["min_v", "max_v"], limits, dbc, unit: "V", input };
        if range.check() {
            voltages_of_model(&range, model);
        }
    }
}

impl AllowedRange<'_> {
    /// Returns whether the range allows any value, and reports a fault if it does not.
    fn check(&self) -> bool {
        let AllowedRange { place, keys: [low_key, high_key], limits, dbc, unit, input } = self;
        let origin = if *unit == "V" { "of the DBC or the cell model" } else { "of the DBC" };
        let (low, high) = (digits(limits.min, 9), digits(limits.max, 9));
        if low < high {
            return true;
        }
        match (place.has(low_key), place.has(high_key)) {
            (true, true) => {} // reported where the keys are compared
            (false, true) => {
                let what = format!("must be above {low} {unit}, the smallest plausible value {origin}");
                place.fault(high_key, &what);
            }
            (true, false) => {
                let what = format!("must be below {high} {unit}, the largest plausible value {origin}");
                place.fault(low_key, &what);
            }
            (false, false) => {
                let (from, to) = (digits(dbc.0, 9), digits(dbc.1, 9));
                let what = format!(
                    "the DBC's range is {from} to {to} {unit} after scale, must contain plausible values (set [{}] to override it)",
                    place.path
                );
                if let Some(input) = input {
                    input.fault("signal", &what);
                }
            }
        }
        false
    }
}

/// Reports limits that exclude the whole voltage range of the cell model.
fn voltages_of_model(range: &AllowedRange<'_>, model: &CellModel) {
    let Limits { min, max, .. } = range.limits;
    let (low, high) = (model.voltage_min_v, model.voltage_max_v);
    // The check of the model file reports an empty range.
    if low >= high || min < high && max > low {
        return;
    }
    let what =
        format!("allows {} to {} V, must overlap the cell model's {low} to {high} V", digits(min, 9), digits(max, 9));
    let key = range.keys[usize::from(max <= low)];
    match range.input.filter(|_| !range.place.has(key)) {
        Some(input) => input.fault("signal", &what),
        None => range.place.fault(key, &what),
    }
}

pub(crate) fn initial_capacity(raw: &RawTables, model: Option<&CellModel>) {
    let (Some(pack), Some(model)) = (&raw.pack, model) else { return };
    initial_of(&pack.place, pack.initial_capacity_ah, model);
}

/// Reports an implausible initial or rated capacity of a module (cells of another type in the same pack). Also reports
/// a module whose rated capacity differs much from `own_ah`, the rated capacity of the pack's own cells.
pub(crate) fn module(Module { keys, model, .. }: &Module<'_>, own_ah: Option<f64>) {
    let beside = own_ah.map_or(1.0, |own_ah| model.rated_capacity_ah / own_ah);
    if let Some(own_ah) = own_ah.filter(|_| beside.max(1.0 / beside) >= OTHER_CELL) {
        let (ratio, own_ah) = (digits(beside, 3), digits(own_ah, 3));
        let what = format!("have {ratio} times the {own_ah} Ah of the pack's own cells, which carry the same current");
        keys.place.warn("cells", &what);
    }
    initial_of(&keys.place, keys.initial_capacity_ah, model);
    let ratio = model.rated_capacity_ah / model.capacity_ah;
    if ratio.max(1.0 / ratio) >= OTHER_CELL {
        let what = format!(
            "must be the capacity of one cell of {:?}, which has {} Ah",
            model.name,
            digits(model.capacity_ah, 3)
        );
        keys.place.fault("rated_capacity_ah", &what);
    }
}

fn initial_of(place: &TablePlace, initial_ah: Option<f64>, model: &CellModel) {
    let Some(initial_ah) = initial_ah else { return };
    if !bounds::INITIAL_CAPACITY.has(initial_ah / model.capacity_ah) {
        let [low, high] =
            [bounds::INITIAL_CAPACITY.low, bounds::INITIAL_CAPACITY.high].map(|by| digits(by * model.capacity_ah, 3));
        place.fault(
            "initial_capacity_ah",
            format!("must be plausible for a cell of {:?}, {low} to {high} Ah", model.name),
        );
    }
}

/// Reports a rated capacity that does not fit the cell model.
pub(crate) fn rated_capacity(raw: &RawTables, model: Option<&CellModel>) {
    let (Some(pack), Some(model)) = (&raw.pack, model) else { return };
    let Some(rated_ah) = pack.rated_capacity_ah else { return };
    let ratio = rated_ah / model.rated_capacity_ah;
    let unlike = ratio.max(1.0 / ratio);
    if unlike < 1.25 {
        return;
    }
    let model_ah = digits(model.rated_capacity_ah, 3);
    let found = format!("is {} times the {model_ah} Ah of the cell model {:?}", digits(ratio, 3), model.name);
    let hint = parallel_cells(ratio, pack.strings);
    if unlike >= OTHER_CELL {
        let [low, high] = [1.0 / OTHER_CELL, OTHER_CELL].map(|by| digits(model.rated_capacity_ah * by, 3));
        let what = format!("{found}, must be the capacity of one cell of this model, {low} to {high} Ah{hint}");
        pack.place.fault("rated_capacity_ah", &what);
    } else {
        let soh = digits(100.0 * pack.initial_capacity_ah.unwrap_or(model.capacity_ah) / rated_ah, 3);
        let what = format!("{found}: SOH starts at {soh} %, and the resistances are for a cell of {model_ah} Ah{hint}");
        pack.place.warn("rated_capacity_ah", &what);
    }
}

/// The configured capacity is `ratio` times the capacity of one cell. Returns a hint whether parallel cells explain
/// this ratio; empty for a ratio of at most 1.
fn parallel_cells(ratio: f64, strings: u16) -> String {
    // The capacities that different sources state for the same cell differ by less than 5 %.
    let is_about = |cells: f64| (ratio / cells - 1.0).abs() <= 0.05;
    let whole = ratio.round();
    if strings > 1 && is_about(f64::from(strings)) {
        format!("; it seems to be the capacity of all {strings} strings together")
    } else if whole >= 2.0 && is_about(whole) {
        let strings = whole * f64::from(strings);
        format!("; for {whole} cells in parallel set strings = {strings} and remove this key")
    } else if ratio > 1.0 {
        "; no number of parallel cells explains it".to_owned()
    } else {
        String::new()
    }
}
