//! Converts an OBDb signal to a signal of a diagnostic input: position, scaling, range, unit.
//!
//! * factor = `mul` / `div`, offset = `add`. As in OBDb's own decoder, `min` defaults to 0. OBDb's decoder clamps
//!   values to `min` and `max`; here, a value outside this range is a bad reading. A signal without `max` is rejected.
//!   If `max` is not above `min`, only the bits limit the range.
//! * `nullmin`, `nullmax`: values at or beyond these limits are not available. If only a few codes are affected, they
//!   are listed. Otherwise, the allowed range ends before these limits.
//! * All units are kept, including degrees Fahrenheit. Nothing is converted.

use super::document::{FormatDocument, SignalDocument};
use crate::import::{DiagnosticSignal, ExclusionReason};

/// Maximum number of codes that are listed as "not available". A longer list is hard to read.
const MAX_LISTED_CODES: usize = 8;
/// Number of bits of the longest ISO-TP message with a 12-bit length.
const MAX_BITS: i64 = 4095 * 8;

/// Units: OBDb's name, `=`, symbol. A number without a unit has an empty symbol.
const UNITS: &str = "ampereHours=Ah amps=A bars=bar celsius=degC centimeters=cm coulombs=C degrees=deg fahrenheit=degF feet=ft \
    hertz=Hz hours=h joules=J kelvin=K kiloampereHours=kAh kiloamps=kA kilohertz=kHz kilojoules=kJ \
    kilometers=km kilometersPerHour=km/h kiloohms=kOhm kilopascal=kPa kilovolts=kV kilowattHours=kWh \
    kilowatts=kW liters=l megahertz=MHz megaohms=MOhm meters=m metersPerSecond=m/s \
    metersPerSecondSquared=m/s2 microohms=uOhm miles=mi milesPerHour=mph milliampereHours=mAh milliamps=mA \
    millimeters=mm milliohms=mOhm milliseconds=ms millivolts=mV milliwatts=mW minutes=min newtonMeters=Nm \
    normal= noyes= offon= ohms=Ohm percent=% radians=rad scalar= seconds=s unknown= volts=V watts=W yesno=";

type Fault = (ExclusionReason, String);

/// Converts one signal. Its name is the whole `id`.
pub(super) fn convert(document: &SignalDocument) -> Result<DiagnosticSignal, Fault> {
    let SignalDocument { id, fmt, .. } = document;
    let invalid = |what: String| (ExclusionReason::InvalidField, what);
    if !super::is_name(id) {
        return Err(invalid(format!("id is \"{id}\", must be letters, digits and _")));
    }
    if fmt.map.is_some() {
        return Err((ExclusionReason::Enumeration, "must be a number with max and unit".to_owned()));
    }
    let unit = fmt.unit.as_deref().unwrap_or_default();
    if matches!(unit, "ascii" | "hex") {
        return Err((ExclusionReason::Text, format!("unit is {unit}")));
    }
    let (bit, length) = place(fmt).map_err(invalid)?;
    let (factor, offset) = scaling(fmt).map_err(invalid)?;
    let mut known = UNITS.split(' ').filter_map(|pair| pair.split_once('='));
    let unit = known.find(|(theirs, _)| *theirs == unit).map_or(unit, |(_, ours)| ours).to_owned();
    if unit.chars().any(|c| c == '"' || c == '\\' || c.is_control()) {
        return Err(invalid(format!("unit is {unit:?}, must be without quotes and control characters")));
    }
    let little_endian = fmt.blsb && length > 8;
    let (range, not_available) = (None, Vec::new());
    let mut signal = DiagnosticSignal {
        name: id.clone(),
        bit,
        length,
        signed: fmt.sign,
        little_endian,
        factor,
        offset,
        unit,
        range,
        not_available,
        numbers: None,
    };
    limit(&mut signal, fmt).map_err(invalid)?;
    Ok(signal)
}

fn place(fmt: &FormatDocument) -> Result<(u32, u32), String> {
    let FormatDocument { bix, len, blsb, .. } = *fmt;
    if !(1..=64).contains(&len) {
        return Err(format!("len is {len}, must be 1 to 64 bits"));
    }
    if bix < 0 || bix > MAX_BITS - len {
        return Err(format!("bix is {bix}, must be 0 to {}: an answer has at most 4095 bytes", MAX_BITS - len));
    }
    if blsb && len > 8 && (bix % 8 != 0 || len % 8 != 0) {
        return Err(format!("blsb with bix {bix} and len {len}, both must be whole bytes"));
    }
    let small = |number: i64| u32::try_from(number).unwrap_or(u32::MAX);
    Ok((small(bix), small(len)))
}

fn scaling(fmt: &FormatDocument) -> Result<(f64, f64), String> {
    let factor = fmt.mul / fmt.div;
    if !factor.is_finite() || factor == 0.0 {
        return Err(format!("mul / div is {} / {}, must be finite and not 0", fmt.mul, fmt.div));
    }
    Ok((factor, fmt.add))
}

fn limit(signal: &mut DiagnosticSignal, fmt: &FormatDocument) -> Result<(), String> {
    let max = fmt.max.ok_or("max is missing, must be given for a number")?;
    let mut range = if max > fmt.min { (fmt.min, max) } else { signal.representable() };
    let is_null =
        |value: f64| fmt.nullmin.is_some_and(|null| value <= null) || fmt.nullmax.is_some_and(|null| value >= null);
    let codes = listed_codes(signal, is_null);
    if codes.is_none() {
        let step = signal.factor.abs();
        range.0 = range.0.max(fmt.nullmin.map_or(f64::MIN, |null| null + step));
        range.1 = range.1.min(fmt.nullmax.map_or(f64::MAX, |null| null - step));
        if range.0 > range.1 {
            return Err(format!("nullmin and nullmax leave no value between {} and {max}", fmt.min));
        }
    }
    signal.not_available = codes.unwrap_or_default();
    let (low, high) = signal.representable();
    // Tolerance for the rounding of the decimals in the file.
    let room = 1e-6 * signal.factor.abs();
    signal.range = (low < range.0 - room || high > range.1 + room).then_some(range);
    Ok(())
}

/// Returns the codes (bits of the signal) that mean "not available"; `None` = there are too many to list.
fn listed_codes(signal: &DiagnosticSignal, is_null: impl Fn(f64) -> bool) -> Option<Vec<u64>> {
    let (low, high) = signal.codes();
    let value = |code: f64| code * signal.factor + signal.offset;
    let from_end = |start: f64, step: f64| {
        let codes = (0..=MAX_LISTED_CODES).map(move |n| start + step * n as f64);
        codes.take_while(|code| (low..=high).contains(code) && is_null(value(*code))).collect::<Vec<_>>()
    };
    let mut codes = from_end(low, 1.0);
    codes.extend(from_end(high, -1.0).into_iter().rev().filter(|code| !codes.contains(code)).collect::<Vec<_>>());
    // Bits of a negative code in two's complement.
    let bits = |code: f64| if code < 0.0 { (code + 2.0 * -low) as u64 } else { code as u64 };
    (codes.len() <= MAX_LISTED_CODES).then(|| codes.into_iter().map(bits).collect())
}
