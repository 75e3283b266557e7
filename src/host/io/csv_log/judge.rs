//! Judges the first rows of a table. Finds the units that the header does not state and the sign of the current, and
//! checks that the values are possible in the stated units.
//!
//! In: the first rows (at most a megabyte), the layout and the options. Out: a [`Judgement`], or an error that names
//! the column, what was found and the probable unit.

use super::CsvOptions;
use super::dictionary::Format;
use super::layout::{Column, Layout};
use super::state::{CurrentSign, Direction, SignSource, direction};
use super::time_text::{TimeForm, TimeText};
use crate::can::decode::Channel;
use crate::io::plausible::{self, Implausible, PackSize, ShownSign, median};
use crate::io::table::{FirstRows, Header, Row, TableError};
use crate::io::units::Unit;

#[derive(Debug)]
pub(super) struct Judgement {
    pub(super) time: TimeText,
    pub(super) time_form: TimeForm,
    /// Whether the unit of time is a guess.
    pub(super) is_time_assumed: bool,
    /// Whether the first row has a later time than the next rows, although the next rows are in order.
    pub(super) is_first_time_late: bool,
    pub(super) sign: CurrentSign,
    pub(super) notes: Vec<String>,
}

#[derive(Debug, Default)]
struct Samples {
    time_texts: Vec<String>,
    /// Times as numbers in the unit of the file. NaN for a time that is not a number, such as a date.
    raw_times: Vec<f64>,
    currents: Vec<f64>,
    voltages: Vec<f64>,
    temperatures: Vec<Vec<f64>>,
    states: Vec<Vec<u8>>,
    directions: Vec<Option<Direction>>,
    discharged: Vec<f64>,
    socs: Vec<f64>,
    sections: Vec<Vec<u8>>,
}

impl Samples {
    fn read(first: &FirstRows, layout: &Layout) -> Self {
        let mut samples = Self::default();
        first.rows().for_each(|row| samples.add(&row, layout));
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
        let state = layout.state.and_then(|column| row.bytes(column)).unwrap_or_default();
        self.states.push(state.to_vec());
        self.directions.push(direction(state));
        self.discharged.push(layout.discharged.as_ref().map_or(f64::NAN, |(column, factor)| factor * value(column)));
        self.sections.extend(layout.section.map(|column| row.bytes(column).unwrap_or_default().to_vec()));
    }
}

pub(super) fn judge(first: &FirstRows, layout: &mut Layout, options: &CsvOptions) -> Result<Judgement, TableError> {
    let mut samples = Samples::read(first, layout);
    if options.pack_total {
        samples.voltages.iter_mut().for_each(|v| *v /= f64::from(options.series.max(1)));
    }
    Judge { header: &first.header, options, samples, notes: std::mem::take(&mut layout.notes) }.run(layout)
}

/// If the state column contains more different numbers than this, the numbers are not used as states.
const MAX_CODES: usize = 8;

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
        self.temperature_units(layout);
        self.soc_unit(layout);
        let (time, time_form, is_time_assumed, times) = self.times(layout)?;
        self.keep_section(layout, &times);
        let sign = self.sign(layout, &times)?;
        let mut trial = sign.clone();
        let signed = |(&current, state): (&f64, &Vec<u8>)| {
            let direction = trial.direction(state);
            trial.discharge(current, direction).unwrap_or(f64::NAN)
        };
        let currents: Vec<f64> = self.samples.currents.iter().zip(&self.samples.states).map(signed).collect();
        if layout.section.is_none() {
            let size = PackSize { capacity_ah: self.options.capacity_ah };
            let response = plausible::check_response(&times, &currents, &self.samples.voltages, size);
            response.map_err(|mut of| {
                if of.quantity == "time" {
                    of.probable =
                        (time_form == TimeForm::Number).then(|| self.other_time_unit(time.unit, false)).flatten();
                }
                self.fault(layout, &of)
            })?;
        }
        self.compare_charge(layout, &times, &currents)?;
        let next = &times[times.len().min(1)..times.len().min(4)];
        let is_first_time_late = next.len() > 1 && next.is_sorted() && next.iter().all(|time| *time < times[0]);
        Ok(Judgement { time, time_form, is_time_assumed, is_first_time_late, sign, notes: self.notes })
    }

    /// The error for a column whose values are impossible in its unit.
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
        let symbol = column.map_or("", |column| column.unit.symbol);
        let is_too_small = of.quantity == "voltage" && of.probable.is_none() && symbol == "mV";
        // Do not propose the unit that the values already have.
        let probable = if is_too_small { Some("V") } else { of.probable.filter(|&unit| unit != symbol) };
        let hint = probable.map_or_else(
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
            // Single impossible currents are rejected row by row.
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

    /// Finds temperatures in kelvin, and leaves out columns with impossible temperatures.
    fn temperature_units(&mut self, layout: &mut Layout) {
        let mut medians = self.samples.temperatures.iter().map(|values| median(values));
        layout.channels.retain_mut(|(channel, column)| {
            let is_temperature = matches!(channel, Channel::Temperature(_));
            let Some(median) = is_temperature.then(|| medians.next().flatten()).flatten() else { return true };
            let name = &self.header.names()[column.index];
            let note = match (column.is_stated, median) {
                (false, 200.0..400.0) => {
                    column.unit = Unit::find("K").unwrap_or(column.unit);
                    format!("column {name} has no unit and is in K by its size")
                }
                (_, 150.0..) | (_, ..-100.0) => {
                    let remedy =
                        format!("write the unit (K or F) into the header, or use --column temperature='{name}[K]'");
                    self.notes.push(format!("column {name} is left out: {median} degrees C is impossible; {remedy}"));
                    return false;
                }
                (false, 60.0..) => format!("column {name} has no unit, degrees C are assumed"),
                _ => return true,
            };
            self.notes.push(note);
            true
        });
    }

    /// Finds the unit of a reported SOC. If no unit fits, leaves out the column.
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

    /// Finds the form and unit of the times. Also returns the times of the rows (s).
    fn times(&mut self, layout: &Layout) -> Result<(TimeText, TimeForm, bool, Vec<f64>), TableError> {
        let texts = &self.samples.time_texts;
        let first = texts.iter().find(|text| text.contains(|c: char| c.is_ascii_digit()));
        let form = first.map_or(TimeForm::Number, |text| TimeText::form(text));
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
            // Times out of range are not parsed, so check the numbers themselves.
            let raw: Vec<f64> = self.samples.raw_times.iter().map(|&time| unit.convert(time)).collect();
            plausible::check_dates(&raw).map_err(|of| self.fault(layout, &of))?;
        }
        if layout.section.is_none() {
            plausible::check_order(&times).map_err(|of| self.fault(layout, &of))?;
        }
        if form == TimeForm::Number && layout.time.is_stated {
            self.note_other_unit(layout, unit, &times);
        }
        Ok((reader, form, is_assumed, times))
    }

    /// Whether the dates of the table begin with the day. If the dates allow both orders (day or month first), the
    /// order that gives the shorter record is assumed.
    fn is_day_first(&mut self, form: TimeForm) -> bool {
        if form != TimeForm::Date {
            return false;
        }
        let (is_day_first, is_open) = TimeText::is_day_first(&self.samples.time_texts);
        if is_open {
            let order = if is_day_first { "day/month/year, which is the shorter record" } else { "month/day/year" };
            self.notes.push(format!("dates are read as {order}"));
        }
        is_day_first
    }

    /// The unit of times that are numbers without a unit, and whether this unit is a guess.
    fn unstated_time_unit(&self, layout: &Layout) -> (&'static Unit, bool) {
        let raw = &self.samples.raw_times;
        let find = |symbol: &str| Unit::find(symbol).unwrap_or(layout.time.unit);
        let middle = median(raw);
        if let Some(unit) = middle.and_then(plausible::probable_stamp_unit) {
            return (find(unit), false);
        }
        let (Some(middle), true) = (middle, raw.len() > 2) else { return (layout.time.unit, true) };
        if middle > 1e8 {
            // Seconds since 1970.
            return (layout.time.unit, false);
        }
        // If times are written in whole seconds, several rows may have the same time.
        let mut distinct = raw.clone();
        distinct.dedup();
        let step = plausible::median_step(&distinct).unwrap_or_default();
        let days = find("Excel days");
        // Numbers in this range may be Excel days from 1970 to 2100 whose rows are at most some minutes apart. If they
        // were seconds, the rows would be less than 4 ms apart.
        if (25_569.0..73_051.0).contains(&middle) && step > 0.0 && step < 0.004 && self.is_possible_time_unit(raw, days)
        {
            return (days, true);
        }
        let by_charge = ["s", "min", "h", "ms", "us"]
            .into_iter()
            .find(|symbol| self.charge_ratio(raw, find(symbol)).is_some_and(|ratio| (0.9..1.1).contains(&ratio)));
        if let Some(symbol) = by_charge {
            return (find(symbol), false);
        }
        // Rows are rarely more than ten minutes or less than 5 ms apart.
        let usual = if step >= 500.0 { ["ms", "us", "ns", "s"] } else { ["s", "ms", "min", "h"] };
        let is_usual = |symbol: &&str| find(symbol).convert(step) >= 0.005 || step <= 0.0;
        let mut candidates = grid_unit(raw).into_iter().chain(usual.into_iter().filter(is_usual)).chain(["s"]);
        let unit = candidates.find(|symbol| self.is_possible_time_unit(raw, find(symbol)));
        (unit.map_or(layout.time.unit, find), true)
    }

    /// Whether currents and voltages are plausible if the times are in `unit`.
    fn is_possible_time_unit(&self, raw: &[f64], unit: &Unit) -> bool {
        let Some(capacity_ah) = self.options.capacity_ah else { return true };
        let times: Vec<f64> = raw.iter().map(|&time| unit.convert(time)).collect();
        let Samples { currents, voltages, .. } = &self.samples;
        plausible::check_charge(&times, currents, capacity_ah).is_ok()
            && plausible::check_slope(&times, currents, voltages, capacity_ah).is_ok()
    }

    /// The ratio of two charges, under the assumption that the times are in `unit`: the charge computed from the
    /// currents, divided by the charge that a column of the table states. Three kinds of rows do not count: gaps, small
    /// currents (which may be an offset), and rows in which the column restarts.
    fn charge_ratio(&self, raw_times: &[f64], unit: &Unit) -> Option<f64> {
        let Samples { currents, discharged, .. } = &self.samples;
        let longest = plausible::longest_step(raw_times);
        let smallest = 0.05 * currents.iter().copied().filter(|i| i.is_finite()).fold(0.0, |max, i| i.abs().max(max));
        // For each possible sign of the current: the charge computed from the currents, and the charge of the column.
        let mut sums = [(0.0, 0.0); 2];
        for (n, step) in raw_times.windows(2).enumerate().map(|(n, pair)| (n, pair[1] - pair[0])) {
            let (current, change) = (currents[n], discharged[n + 1] - discharged[n]);
            if (0.0..=longest).contains(&step) && current.abs() >= smallest && change.is_finite() {
                let charge = current.abs() * unit.convert(step) / 3600.0;
                for (sum, _) in sums.iter_mut().zip([1.0, -1.0]).filter(|(_, sign)| sign * current * change >= 0.0) {
                    *sum = (sum.0 + charge, sum.1 + change.abs());
                }
            }
        }
        let (charge, stated) = if sums[0].1 > sums[1].1 { sums[0] } else { sums[1] };
        (charge > 0.0 && stated > 0.0).then(|| charge / stated)
    }

    /// Returns the next longer unit (if `is_longer`), or else the next shorter unit, that is possible for this table
    /// and gives rows at least 20 ms apart.
    fn other_time_unit(&self, unit: &Unit, is_longer: bool) -> Option<&'static str> {
        let raw = &self.samples.raw_times;
        let step = plausible::median_step(raw).unwrap_or_default();
        let is_possible = |symbol: &&str| {
            let other = Unit::find(symbol).unwrap_or(unit);
            let ratio = unit.per_base() / other.per_base();
            (if is_longer { ratio > 1.0 } else { ratio < 1.0 })
                && other.convert(step) >= 0.02
                && self.is_possible_time_unit(raw, other)
        };
        let units = ["ns", "us", "ms", "s", "min", "h"];
        if is_longer { units.into_iter().find(is_possible) } else { units.into_iter().rev().find(is_possible) }
    }

    /// Adds a note if the times are probably not in the stated unit. Signs of this are: the voltage changes although
    /// too little charge flows; or the times advance like whole seconds that are written in a longer unit; or they
    /// advance by less than 0.1 s per row in a unit shorter than a second.
    fn note_other_unit(&mut self, layout: &Layout, stated: &Unit, times: &[f64]) {
        let Samples { currents, voltages, .. } = &self.samples;
        let slope = self.options.capacity_ah.and_then(|ah| plausible::check_slope(times, currents, voltages, ah).err());
        let raw = &self.samples.raw_times;
        let grid = grid_unit(raw).filter(|unit| {
            let unit = Unit::find(unit).unwrap_or(stated);
            unit.per_base() < stated.per_base() && self.is_possible_time_unit(raw, unit)
        });
        let step_s = plausible::median_step(times).unwrap_or_default();
        let is_short = stated.per_base() > 1.0 && step_s < 0.1 && self.options.capacity_ah.is_some();
        let longer = || self.other_time_unit(stated, true);
        let (what, unit) = match (slope, grid) {
            (Some(of), grid) => (of.what, grid.or_else(longer).or(of.probable)),
            (_, Some(unit)) => (format!("advances like {unit}"), Some(unit)),
            _ => (format!("advances by {step_s} s per row"), longer().filter(|_| is_short)),
        };
        let (name, Some(unit)) = (&self.header.names()[layout.time.index], unit) else { return };
        self.notes.push(format!(
            "column {name} {what}, but is read in {}; if it is in {unit}, use --column time='{name}[{unit}]'",
            stated.symbol
        ));
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

    /// A section column divides the table into parts with their own time. If the user did not name this column, and the
    /// time does not restart where its value changes, the column is not used.
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

    /// Finds from the voltage which of the states that are numbers mean charge, and which mean discharge. The list is
    /// empty unless the voltage shows both a charge and a discharge.
    fn codes(&self, layout: &Layout, times: &[f64]) -> Vec<(Vec<u8>, Direction)> {
        let Samples { states, currents, voltages, .. } = &self.samples;
        let mut codes: Vec<Vec<u8>> = states.iter().filter(|state| is_code(state)).cloned().collect();
        codes.sort();
        codes.dedup();
        if layout.state.is_none() || codes.len() > MAX_CODES {
            return Vec::new();
        }
        let shown = codes.into_iter().filter_map(|code| {
            let of_code = |(&i, state): (&f64, &Vec<u8>)| if *state == code || i == 0.0 { i } else { f64::NAN };
            let currents: Vec<f64> = currents.iter().zip(states).map(of_code).collect();
            match plausible::shown_sign(times, &currents, voltages) {
                ShownSign::Charge => Some((code, Direction::Charge)),
                ShownSign::Discharge => Some((code, Direction::Discharge)),
                ShownSign::Magnitude | ShownSign::Unclear => None,
            }
        });
        let shown: Vec<_> = shown.collect();
        let has = |direction| shown.iter().any(|of| of.1 == direction);
        if has(Direction::Charge) && has(Direction::Discharge) { shown } else { Vec::new() }
    }

    fn sign(&mut self, layout: &Layout, times: &[f64]) -> Result<CurrentSign, TableError> {
        if let Some(is_charge_positive) = self.options.charge_positive {
            return Ok(CurrentSign::new(is_charge_positive, SignSource::User));
        }
        let samples = &self.samples;
        let largest = samples.currents.iter().filter(|i| i.is_finite()).fold(0.0_f64, |max, i| max.max(i.abs()));
        let negative = samples.currents.iter().filter(|&&i| i < -0.001 * largest).count();
        let count = |wanted: Direction, is_positive: bool| {
            let rows = samples.directions.iter().zip(&samples.currents);
            rows.filter(|&(direction, &i)| {
                *direction == Some(wanted) && i.abs() > 0.01 * largest && (i > 0.0) == is_positive
            })
            .count()
        };
        let [discharges, charges] = [Direction::Discharge, Direction::Charge].map(|direction| count(direction, true));
        // If the current is positive in charges and in discharges, it is a magnitude, so single negative currents are
        // faults.
        let is_magnitude = negative < charges.min(discharges) && 100 * negative <= samples.currents.len();
        let is_never_negative = negative == 0 || is_magnitude;
        let codes = if is_never_negative { self.codes(layout, times) } else { Vec::new() };
        if is_never_negative && discharges + charges + codes.len() > 0 {
            let noise_a = 0.01 * largest;
            self.notes.extend(codes.iter().map(|(code, direction)| {
                format!("state {} is a {direction:?} by the voltage", String::from_utf8_lossy(code)).to_lowercase()
            }));
            let [has_positive_charge, has_positive_discharge] =
                [charges, discharges].map(|count| count > 0 || !codes.is_empty());
            let by_state = CurrentSign::new(true, SignSource::State);
            return Ok(CurrentSign {
                is_by_state: true,
                has_positive_charge,
                has_positive_discharge,
                noise_a,
                codes,
                ..by_state
            });
        }
        let samples = &self.samples;
        let shown = plausible::shown_sign(times, &samples.currents, &samples.voltages);
        if shown == ShownSign::Magnitude {
            let name = layout.current().map_or("", |column| self.header.names()[column.index].as_str());
            return Err(self.header.fault(format_args!(
                "column {name}: the current is never negative, but the voltage rises with it in one part and falls in \
                 another: a magnitude without a sign; name the column that says charge or discharge with --column \
                 state=NAME, or give --csv-sign"
            )));
        }
        if is_never_negative && largest > 0.0 && layout.format.charge_positive().is_none() {
            self.notes.push("the current is never negative in the first rows".to_owned());
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
            return Ok(CurrentSign::new(is_charge_positive, SignSource::Format));
        }
        if let Some(is_charge_positive) = from_state {
            return Ok(CurrentSign::new(is_charge_positive, SignSource::State));
        }
        match shown {
            ShownSign::Charge => return Ok(CurrentSign::new(true, SignSource::Voltage)),
            ShownSign::Discharge => return Ok(CurrentSign::new(false, SignSource::Voltage)),
            ShownSign::Magnitude | ShownSign::Unclear => {}
        }
        self.notes.push("nothing shows the sign of the current; --csv-sign charge reverses it".to_owned());
        Ok(CurrentSign::new(false, SignSource::Nothing))
    }
}

/// Whether a state is a number, whose meaning only the voltage can show.
fn is_code(state: &[u8]) -> bool {
    !state.is_empty() && state.iter().all(u8::is_ascii_digit)
}

fn is_voltage(channel: Channel) -> bool {
    matches!(channel, Channel::PackVoltage | Channel::CellVoltage(_))
}

/// Returns min or h if the times are whole seconds when they are read in this unit (example: rows 1/60 min apart).
/// `None` if this holds for neither unit, or if the times have even steps with at most four decimals, because such
/// times are usually seconds.
fn grid_unit(times: &[f64]) -> Option<&'static str> {
    let step = plausible::median_step(times).filter(|step| (0.0..0.9).contains(step) && *step > 0.0)?;
    let known: Vec<f64> = times.iter().copied().filter(|time| time.is_finite()).collect();
    let is_most = |is: &dyn Fn(f64) -> bool| known.iter().filter(|time| is(**time)).count() * 10 >= known.len() * 9;
    let is_whole = |value: f64, tolerance: f64| (value - value.round()).abs() <= tolerance;
    let digits = (1..9).find(|&digits| is_most(&|time| is_whole(time * 10_f64.powi(digits), 1e-6))).unwrap_or(9);
    let has_decimal_step = is_whole(step * 1e4, 1e-6) && is_most(&|time| is_whole((time - known[0]) / step, 1e-6));
    if has_decimal_step || known.len() < 20 {
        return None;
    }
    let unit = [("min", 60.0), ("h", 3600.0)].into_iter().find(|(_, factor)| {
        let rounding = factor * (0.5 * 10_f64.powi(-digits)) + 1e-6;
        rounding < 0.35 && is_most(&|time| is_whole(time * factor, rounding))
    });
    unit.map(|of| of.0)
}

#[cfg(test)]
mod tests {
    use super::*;

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
