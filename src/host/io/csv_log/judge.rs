//! Judges the first rows of a table: units that the header does not state, the sign of the current, and whether the
//! values can be what the header says.
//!
//! In: the first rows (at most a megabyte), the layout and the options. Out: a [`Judgement`], or an error that names
//! the column, what was found and the probable unit.

use super::CsvOptions;
use super::dictionary::Format;
use super::layout::{Column, Layout};
use super::time_text::{TimeForm, TimeText};
use crate::can::decode::Channel;
use crate::io::plausible::{self, Implausible, PackSize, ShownSign, median};
use crate::io::table::{Header, Row, Table, TableError};
use crate::io::units::Unit;

/// Largest number of rows that are judged.
const MAX_ROWS: usize = 50_000;

/// Direction of the current in a row, according to the state column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Direction {
    Charge,
    Discharge,
}

/// Reads the direction from a state such as `D`, `CC_DChg`, `CHA`, `Discharging` or `Rest` (`None`).
pub(super) fn direction(state: &[u8]) -> Option<Direction> {
    let text = String::from_utf8_lossy(state).to_lowercase();
    let text = text.trim().trim_matches('"');
    let has = |words: &[&str]| words.iter().any(|word| text.contains(word));
    if text == "d" || text == "dis" || has(&["dch", "dischg", "discharg", "dis-charg", "entlad", "\u{653e}\u{7535}"]) {
        Some(Direction::Discharge)
    } else if text == "c"
        || has(&["chg", "cha", "charg", "chrg", "regen", "\u{5145}\u{7535}"]) && !has(&["change", "channel"])
    {
        Some(Direction::Charge)
    } else {
        None
    }
}

/// What decides the sign of the current.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SignSource {
    User,
    Format,
    State,
    Voltage,
    Nothing,
}

/// Sign of the current.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct CurrentSign {
    pub(super) is_charge_positive: bool,
    /// Whether the current is a magnitude whose sign the state column gives.
    pub(super) is_by_state: bool,
    /// Whether a positive current in a discharge has shown that it is a magnitude.
    pub(super) is_magnitude_shown: bool,
    pub(super) source: SignSource,
}

/// The result.
#[derive(Debug)]
pub(super) struct Judgement {
    pub(super) time: TimeText,
    pub(super) time_form: TimeForm,
    /// Whether the unit of time is a guess.
    pub(super) is_time_assumed: bool,
    pub(super) sign: CurrentSign,
    /// Remarks for the user.
    pub(super) notes: Vec<String>,
}

/// Values of the first rows.
#[derive(Debug, Default)]
struct Samples {
    time_texts: Vec<String>,
    /// Times as numbers in the unit of the file; only for times without colons.
    raw_times: Vec<f64>,
    currents: Vec<f64>,
    /// Voltage of a cell.
    voltages: Vec<f64>,
    temperatures: Vec<Vec<f64>>,
    directions: Vec<Option<Direction>>,
    discharged: Vec<f64>,
    socs: Vec<f64>,
    sections: Vec<Vec<u8>>,
}

impl Samples {
    fn read(preview: &mut Table, layout: &Layout) -> Self {
        let mut samples = Self::default();
        while let Ok(Some(row)) = preview.next_row() {
            if samples.currents.len() >= MAX_ROWS {
                break;
            }
            samples.add(&row, layout);
        }
        samples
    }

    fn add(&mut self, row: &Row<'_>, layout: &Layout) {
        let value = |column: &Column| row.parsed(column.index).flatten().map_or(f64::NAN, |v| column.unit.convert(v));
        let time = row.text(layout.time.index).trim().trim_matches('"').to_owned();
        if time.is_empty() {
            return;
        }
        self.raw_times.push(row.parsed(layout.time.index).flatten().unwrap_or(f64::NAN));
        self.time_texts.push(time);
        let mut temperatures = 0;
        for (channel, column) in &layout.channels {
            match channel {
                Channel::Current => self.currents.push(value(column)),
                Channel::Temperature(_) => {
                    temperatures += 1;
                    self.temperatures.resize_with(temperatures.max(self.temperatures.len()), Vec::new);
                    self.temperatures[temperatures - 1].push(value(column));
                }
                Channel::ReportedSoc => self.socs.push(value(column)),
                Channel::PackVoltage | Channel::CellVoltage(_) if self.voltages.len() < self.currents.len() => {
                    self.voltages.push(value(column));
                }
                _ => {}
            }
        }
        self.directions.push(layout.state.and_then(|column| row.bytes(column)).and_then(direction));
        self.discharged.push(layout.discharged.as_ref().map_or(f64::NAN, |(column, factor)| factor * value(column)));
        self.sections.extend(layout.section.map(|column| row.bytes(column).unwrap_or_default().to_vec()));
    }
}

/// Judges the first rows, and completes the units of `layout`.
pub(super) fn judge(preview: &mut Table, layout: &mut Layout, options: &CsvOptions) -> Result<Judgement, TableError> {
    let header = preview.header().clone();
    let mut samples = Samples::read(preview, layout);
    if options.pack_total {
        samples.voltages.iter_mut().for_each(|v| *v /= f64::from(options.series.max(1)));
    }
    Judge { header: &header, options, samples, notes: Vec::new() }.run(layout)
}

struct Judge<'a> {
    header: &'a Header,
    options: &'a CsvOptions,
    samples: Samples,
    notes: Vec<String>,
}

impl Judge<'_> {
    fn run(mut self, layout: &mut Layout) -> Result<Judgement, TableError> {
        self.voltage_unit(layout)?;
        self.current_unit(layout)?;
        self.temperature_units(layout)?;
        self.soc_unit(layout);
        let (time, time_form, is_time_assumed, times) = self.times(layout)?;
        self.keep_section(layout, &times);
        let sign = self.sign(layout)?;
        let mut trial = sign;
        let signed = |(&current, direction): (&f64, &Option<Direction>)| {
            trial.discharge(current, *direction).unwrap_or(f64::NAN)
        };
        let currents: Vec<f64> = self.samples.currents.iter().zip(&self.samples.directions).map(signed).collect();
        if layout.section.is_none() {
            let size = PackSize { capacity_ah: self.options.capacity_ah };
            let response = plausible::check_response(&times, &currents, &self.samples.voltages, size);
            response.map_err(|of| self.fault(layout, &of))?;
        }
        self.compare_charge(layout, &times, &currents)?;
        Ok(Judgement { time, time_form, is_time_assumed, sign, notes: self.notes })
    }

    /// The error for a column whose values are not in its unit.
    fn fault(&self, layout: &Layout, of: &Implausible) -> TableError {
        let voltage = || layout.channels.iter().find(|(channel, _)| is_voltage(*channel)).map(|of| of.1);
        let column = match of.quantity {
            "time" => Some(layout.time),
            "current" => layout.current(),
            _ => voltage(),
        };
        let name = column.map_or("", |column| self.header.names()[column.index].as_str());
        let role = match of.quantity {
            "voltage" if !self.options.pack_total && self.options.cells > 1 => "voltage{n}",
            quantity => quantity,
        };
        let hint = of.probable.map_or_else(
            || format!("; name the right column with --column {role}=NAME"),
            |unit| {
                format!("; probably {unit}: write the unit into the header, or use --column {role}='{name}[{unit}]'")
            },
        );
        self.header.fault(format_args!("column {name}: {}{hint}", of.what))
    }

    fn voltage_unit(&mut self, layout: &mut Layout) -> Result<(), TableError> {
        let Err(of) = plausible::check_voltages(&self.samples.voltages) else { return Ok(()) };
        let is_stated = layout.channels.iter().any(|(channel, column)| is_voltage(*channel) && column.is_stated);
        let Some(unit) = of.probable.and_then(Unit::find).filter(|_| !is_stated) else {
            return Err(self.fault(layout, &of));
        };
        for (channel, column) in &mut layout.channels {
            if is_voltage(*channel) {
                column.unit = unit;
            }
        }
        self.samples.voltages.iter_mut().for_each(|v| *v = unit.convert(*v));
        self.notes.push("the voltages have no unit and are in mV by their size".to_owned());
        Ok(())
    }

    fn current_unit(&mut self, layout: &mut Layout) -> Result<(), TableError> {
        let size = PackSize { capacity_ah: self.options.capacity_ah };
        let checked = plausible::check_currents(&self.samples.currents, size);
        let Err(of) = checked else {
            // Single impossible currents are refused row by row.
            let impossible = self.samples.currents.iter_mut().filter(|i| i.abs() > size.max_current_a());
            impossible.for_each(|i| *i = f64::NAN);
            return Ok(());
        };
        let is_stated = layout.current().is_some_and(|column| column.is_stated);
        let Some(unit) = of.probable.and_then(Unit::find).filter(|_| !is_stated) else {
            return Err(self.fault(layout, &of));
        };
        for (_, column) in layout.channels.iter_mut().filter(|(channel, _)| *channel == Channel::Current) {
            column.unit = unit;
        }
        self.samples.currents.iter_mut().for_each(|i| *i = unit.convert(*i));
        self.notes.push("the current has no unit and is in mA by its size".to_owned());
        Ok(())
    }

    /// Finds kelvin; a temperature of 200 degrees Celsius is none.
    fn temperature_units(&mut self, layout: &mut Layout) -> Result<(), TableError> {
        let columns = layout.channels.iter_mut().filter(|(channel, _)| matches!(channel, Channel::Temperature(_)));
        for ((_, column), values) in columns.zip(&self.samples.temperatures) {
            let Some(median) = median(values) else { continue };
            let name = &self.header.names()[column.index];
            match (column.is_stated, median) {
                (false, 200.0..400.0) => {
                    column.unit = Unit::find("K").unwrap_or(column.unit);
                    self.notes.push(format!("column {name} has no unit and is in K by its size"));
                }
                (_, 150.0..) | (_, ..-100.0) => {
                    return Err(self.header.fault(format_args!(
                        "column {name}: {median} degrees C is impossible; write the unit (K or F) into the header, or \
                         use --column temperature='{name}[K]'"
                    )));
                }
                (false, 60.0..) => self.notes.push(format!("column {name} has no unit, degrees C are assumed")),
                _ => {}
            }
        }
        Ok(())
    }

    /// Finds the unit of a reported SOC; a column that fits none is left out.
    fn soc_unit(&mut self, layout: &mut Layout) {
        let largest = self.samples.socs.iter().copied().filter(|soc| soc.is_finite()).fold(0.0, f64::max);
        let unit = match largest {
            ..=1.0 => Some("1"),
            ..=100.0 => Some("%"),
            100.0..=1e6 if layout.format == Format::LeafSpy => Some("ppm"),
            _ => None,
        };
        let unit = unit.and_then(Unit::find);
        layout
            .channels
            .retain(|(channel, column)| *channel != Channel::ReportedSoc || column.is_stated || unit.is_some());
        for (channel, column) in &mut layout.channels {
            if let (Channel::ReportedSoc, false, Some(unit)) = (*channel, column.is_stated, unit) {
                column.unit = unit;
            }
        }
    }

    /// Finds form and unit of the times. Returns the times of the rows (s), too.
    fn times(&mut self, layout: &Layout) -> Result<(TimeText, TimeForm, bool, Vec<f64>), TableError> {
        let form = self.samples.time_texts.first().map_or(TimeForm::Number, |text| TimeText::form(text));
        let (mut unit, mut is_assumed) = (layout.time.unit, false);
        if form == TimeForm::Number && !layout.time.is_stated {
            (unit, is_assumed) = self.unstated_time_unit(layout);
        }
        let mut reader = TimeText::new(unit);
        reader.is_day_first = self.is_day_first(form);
        reader.wraps = !layout.is_step_time;
        let mut trial = reader.clone();
        let texts = self.samples.time_texts.iter();
        let times: Vec<f64> =
            texts.map(|text| trial.parse(text.as_bytes()).map_or(f64::NAN, |time| time.secs())).collect();
        if form == TimeForm::Number {
            // Times out of range were not read, so the numbers themselves are checked.
            let raw: Vec<f64> = self.samples.raw_times.iter().map(|&time| unit.convert(time)).collect();
            plausible::check_dates(&raw).map_err(|of| self.fault(layout, &of))?;
        }
        if layout.section.is_none() {
            plausible::check_order(&times).map_err(|of| self.fault(layout, &of))?;
        }
        if form == TimeForm::Number && layout.time.is_stated && unit.per_base() == 1.0 {
            self.note_other_grid(layout, &times);
        }
        Ok((reader, form, is_assumed, times))
    }

    /// Whether the dates of the table begin with the day. If no date decides, the month is first.
    fn is_day_first(&mut self, form: TimeForm) -> bool {
        if form != TimeForm::Date {
            return false;
        }
        let parts = |text: &String| {
            let mut numbers = text.split(['/', '-', ' ']).map(|part| part.parse::<u32>().unwrap_or(0));
            (numbers.next().unwrap_or(0), numbers.next().unwrap_or(0))
        };
        let texts = &self.samples.time_texts;
        let is_day_first = texts.iter().any(|text| (13..=31).contains(&parts(text).0));
        let is_open = texts.iter().all(|text| (1..13).contains(&parts(text).0) && (1..13).contains(&parts(text).1));
        if is_open && texts.first().is_some_and(|text| text.contains('/')) {
            self.notes.push("dates are read as month/day/year".to_owned());
        }
        is_day_first
    }

    /// The unit of times as numbers without a unit, and whether it is a guess.
    fn unstated_time_unit(&self, layout: &Layout) -> (&'static Unit, bool) {
        let raw = &self.samples.raw_times;
        let find = |symbol: &str| Unit::find(symbol).unwrap_or(layout.time.unit);
        if let Some(unit) = raw.first().and_then(|&first| plausible::probable_stamp_unit(first)) {
            return (find(unit), false);
        }
        let (Some(first), true) = (raw.first(), raw.len() > 2) else { return (layout.time.unit, true) };
        if *first > 1e8 {
            // Seconds since 1970.
            return (layout.time.unit, false);
        }
        let seconds = layout.time.unit;
        for symbol in ["s", "min", "h", "ms"] {
            if self.charge_ratio(raw, find(symbol)).is_some_and(|ratio| (0.9..1.1).contains(&ratio)) {
                return (find(symbol), false);
            }
        }
        (grid_unit(raw).map_or(seconds, find), true)
    }

    /// The charge of the currents over the charge that a column of the table states, if the times are in `unit`.
    fn charge_ratio(&self, raw_times: &[f64], unit: &Unit) -> Option<f64> {
        let stated = &self.samples.discharged;
        let span =
            stated.iter().filter(|q| q.is_finite()).fold((f64::MAX, f64::MIN), |(l, h), &q| (l.min(q), h.max(q)));
        let mut charge = 0.0_f64;
        let (mut low, mut high) = (0.0_f64, 0.0_f64);
        for (pair, current) in raw_times.windows(2).zip(&self.samples.currents) {
            let step_s = unit.convert(pair[1]) - unit.convert(pair[0]);
            if step_s > 0.0 && current.is_finite() {
                charge += current * step_s / 3600.0;
                (low, high) = (low.min(charge), high.max(charge));
            }
        }
        let stated_ah = span.1 - span.0;
        (stated_ah > 0.0 && high > low).then(|| (high - low) / stated_ah)
    }

    /// Notes times that are stated in seconds but advance as minutes or hours do.
    fn note_other_grid(&mut self, layout: &Layout, times: &[f64]) {
        if let Some(unit) = grid_unit(times) {
            let name = &self.header.names()[layout.time.index];
            self.notes.push(format!(
                "column {name} advances like {unit}, but is read in s; if it is in {unit}, use --column \
                 time='{name}[{unit}]'"
            ));
        }
    }

    /// Compares the current with the table's own count of charge.
    fn compare_charge(&mut self, layout: &Layout, times: &[f64], currents: &[f64]) -> Result<(), TableError> {
        if layout.section.is_some() || layout.discharged.is_none() || currents.len() < 10 {
            return Ok(());
        }
        let Some(ratio) = self.charge_ratio(times, Unit::base(crate::io::units::Quantity::Time)) else { return Ok(()) };
        let known = [
            (1000.0, "current", "mA"),
            (0.001, "current", "A"),
            (1.0 / 60.0, "time", "min"),
            (1.0 / 3600.0, "time", "h"),
        ];
        let Some(&(_, quantity, unit)) = known.iter().find(|(factor, _, _)| (0.8..1.25).contains(&(ratio / factor)))
        else {
            return Ok(());
        };
        let what = format!("the current and the times give {ratio:.2e} of the charge that the table states");
        Err(self.fault(layout, &Implausible { quantity, what, probable: Some(unit) }))
    }

    /// Keeps a section column that no one named only if the time restarts at its new values.
    fn keep_section(&self, layout: &mut Layout, times: &[f64]) {
        if layout.is_section_named || layout.format == Format::Packwatch || layout.is_step_time {
            return;
        }
        let sections = &self.samples.sections;
        let changes = sections.windows(2).zip(times.windows(2)).filter(|(pair, _)| pair[0] != pair[1]);
        let mut changes = changes.map(|(_, times)| times[1] < times[0]).peekable();
        if changes.peek().is_some() && !changes.any(|restarts| restarts) {
            layout.section = None;
        }
    }

    fn sign(&mut self, layout: &Layout) -> Result<CurrentSign, TableError> {
        let sign = |is_charge_positive: bool, source: SignSource| CurrentSign {
            is_charge_positive,
            is_by_state: false,
            is_magnitude_shown: false,
            source,
        };
        if let Some(is_charge_positive) = self.options.charge_positive {
            return Ok(sign(is_charge_positive, SignSource::User));
        }
        let samples = &self.samples;
        let largest = samples.currents.iter().filter(|i| i.is_finite()).fold(0.0_f64, |max, i| max.max(i.abs()));
        let is_never_negative = samples.currents.iter().all(|&i| i.is_nan() || i >= -0.001 * largest);
        let count = |wanted: Direction, is_positive: bool| {
            let rows = samples.directions.iter().zip(&samples.currents);
            rows.filter(|&(direction, &i)| {
                *direction == Some(wanted) && i.abs() > 0.01 * largest && (i > 0.0) == is_positive
            })
            .count()
        };
        let [discharges, charges] = [Direction::Discharge, Direction::Charge].map(|direction| count(direction, true));
        if is_never_negative && discharges + charges > 0 {
            let by_state =
                CurrentSign { is_by_state: true, is_magnitude_shown: discharges > 0, ..sign(true, SignSource::State) };
            return Ok(by_state);
        }
        let shown = plausible::shown_sign(&samples.currents, &samples.voltages);
        if shown == ShownSign::Magnitude {
            let name = layout.current().map_or("", |column| self.header.names()[column.index].as_str());
            return Err(self.header.fault(format_args!(
                "column {name}: the current is never negative, but the voltage rises with it in one part and falls in \
                 another: a magnitude without a sign; name the column that says charge or discharge with --column \
                 state=NAME, or give --csv-sign"
            )));
        }
        let by_state = (charges + count(Direction::Discharge, false), discharges + count(Direction::Charge, false));
        let from_state = (by_state.0 + by_state.1 >= 5 && by_state.0.min(by_state.1) * 4 <= by_state.0.max(by_state.1))
            .then_some(by_state.0 > by_state.1);
        if let Some(is_charge_positive) = layout.format.charge_positive() {
            let is_contradicted = shown == if is_charge_positive { ShownSign::Discharge } else { ShownSign::Charge };
            if is_contradicted {
                let (is, flag) = if is_charge_positive { ("charge", "discharge") } else { ("discharge", "charge") };
                self.notes.push(format!(
                    "positive current is read as {is}, but the voltage answers as if it were {flag}; --csv-sign {flag} \
                     reverses it"
                ));
            }
            return Ok(sign(is_charge_positive, SignSource::Format));
        }
        if let Some(is_charge_positive) = from_state {
            return Ok(sign(is_charge_positive, SignSource::State));
        }
        match shown {
            ShownSign::Charge => return Ok(sign(true, SignSource::Voltage)),
            ShownSign::Discharge => return Ok(sign(false, SignSource::Voltage)),
            ShownSign::Magnitude | ShownSign::Unclear => {}
        }
        if is_never_negative && largest > 0.0 {
            self.notes.push("the current is never negative".to_owned());
        }
        self.notes.push("nothing shows the sign of the current; --csv-sign charge reverses it".to_owned());
        Ok(sign(false, SignSource::Nothing))
    }
}

impl CurrentSign {
    /// The current with positive = discharge. `None` if a magnitude is negative.
    pub(super) fn discharge(&mut self, value: f64, direction: Option<Direction>) -> Option<f64> {
        if self.is_by_state && direction == Some(Direction::Discharge) {
            if value >= 0.0 {
                self.is_magnitude_shown = true;
                return Some(value);
            }
            if self.is_magnitude_shown {
                return None;
            }
            // The first discharge is negative: the current has a sign, which the charges before it could not show.
            self.is_by_state = false;
        }
        Some(if self.is_charge_positive { -value } else { value })
    }
}

fn is_voltage(channel: Channel) -> bool {
    matches!(channel, Channel::PackVoltage | Channel::CellVoltage(_))
}

/// The unit in which times advance by whole seconds, if they do not do so in seconds: rows every 1/60 are minutes.
fn grid_unit(times: &[f64]) -> Option<&'static str> {
    let steps: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > 0.0).collect();
    let middle = median(&steps)?;
    // Rounded times have steps of two lengths. Gaps and other sampling rates do not count, and must be rare.
    let usual: Vec<f64> = steps.iter().copied().filter(|step| *step < 3.0 * middle).collect();
    let step = usual.iter().sum::<f64>() / usual.len() as f64;
    let even = usual.iter().filter(|of| (0.5 * step..1.5 * step).contains(*of)).count();
    if even * 10 < steps.len() * 9 {
        return None;
    }
    let is_whole = |value: f64, tolerance: f64| value >= 0.9 && (value - value.round()).abs() < tolerance * value;
    let is_decimal = is_whole(step * 1000.0, 0.0005);
    if step >= 0.9 || is_decimal || usual.len() < 10 {
        return None;
    }
    [("min", 60.0), ("h", 3600.0)].into_iter().find(|(_, factor)| is_whole(step * factor, 0.004)).map(|of| of.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_of_cyclers_give_direction() {
        for (state, expected) in [
            ("D", Some(Direction::Discharge)),
            ("C", Some(Direction::Charge)),
            ("CC DChg", Some(Direction::Discharge)),
            ("CC_Chg", Some(Direction::Charge)),
            ("CCCV Chg", Some(Direction::Charge)),
            ("DCH", Some(Direction::Discharge)),
            ("CHA", Some(Direction::Charge)),
            ("Discharging", Some(Direction::Discharge)),
            ("charging", Some(Direction::Charge)),
            ("Rest", None),
            ("PAU", None),
            ("R", None),
            ("0", None),
        ] {
            assert_eq!(direction(state.as_bytes()), expected, "{state}");
        }
    }

    #[test]
    fn steps_of_a_sixtieth_are_minutes() {
        let times = |step: f64| (0..100).map(|n| (f64::from(n) * step * 100.0).round() / 100.0).collect::<Vec<_>>();
        assert_eq!(grid_unit(&times(1.0 / 60.0)), Some("min"));
        assert_eq!(grid_unit(&(0..100).map(|n| f64::from(n) / 3600.0).collect::<Vec<_>>()), Some("h"));
        for step in [1.0, 0.1, 0.5, 0.02, 0.25, 10.0] {
            assert_eq!(grid_unit(&times(step)), None, "{step}");
        }
    }
}
