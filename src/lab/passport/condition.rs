//! Determines the condition of a battery for a passport: every value with its time and standard deviation, or the
//! reason why it is unknown.
//!
//! Measured and learned values are known. A configured start value, an untrusted estimate and an incomplete sum count
//! as unknown.

use super::energy::Discharge;
use super::field::Field;
use super::losses::is_too_much;
use super::record::{CellRecord, Learned, Record};

use crate::cell::CellModel;
use crate::config::Config;
use crate::health::UseRecord;
use crate::health::use_record::{LimitUse, RangeUse};
use crate::monitor::{Downtime, ModelState, Monitor, Outputs, Snapshot};
use crate::quantity::{CellIndex, Channel, Timestamp, catalogue};

/// Earlier time stamps (before 2001-01-01, s since 1970) are not dates. A clock that was not set starts in 1970, 1980
/// or 2000, and a log that counts from its own start is shorter than 30 years.
const FIRST_DATE_S: f64 = 978_307_200.0;
/// Two statements of the same value of a new battery may be rounded differently. They agree if they differ by at most
/// this fraction.
pub(super) const RATED_TOLERANCE: f64 = 0.01;

/// Data from the command line that no record contains; `None` = not given.
#[derive(Debug, Clone, Copy, Default)]
pub struct Terms {
    /// Charge moved before the record started (Ah); 0 = recorded since new.
    pub moved_before_ah: Option<f64>,
    /// Total charge moved (Ah) from the battery's own counter. Replaces the sum of the record.
    pub moved_ah: Option<f64>,
    /// Usable energy at the certification (kWh).
    pub certified_kwh: Option<f64>,
}

/// A known value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quantity {
    /// Value in the unit of its field.
    pub value: f64,
    /// Standard deviation; `None` = unknown.
    pub std: Option<f64>,
    /// Time at which the value was determined.
    pub time: Timestamp,
}

/// A value, or the reason why it is unknown.
pub type Known = Result<Quantity, String>;

/// All values of a passport that packwatch can determine.
#[derive(Debug)]
pub struct Condition {
    values: Vec<(Field, Known)>,
    rated: Rated,
    use_record: UseRecord,
    time: Timestamp,
}

/// Values of the new battery from configuration and command line. A passport with other values belongs to another
/// battery.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Rated {
    pub(super) capacity_ah: Option<f64>,
    pub(super) energy_kwh: Option<f64>,
}

impl Condition {
    /// Determines all values.
    ///
    /// # Errors
    /// The state is missing, has no date, or does not fit the configuration.
    pub fn new(record: &Record, config: &Config, model: &CellModel, terms: &Terms) -> Result<Self, String> {
        let battery = Battery::new(record, config, model)?;
        let moved = battery.moved_ah(terms);
        let values = Field::ALL.map(|field| (field, battery.value(field, terms, &moved).and_then(dated)));
        let rated = Rated { capacity_ah: Some(battery.rated_ah()), energy_kwh: terms.certified_kwh };
        let time = battery.wall(battery.monitor.now());
        Ok(Self { values: values.to_vec(), rated, use_record: *battery.monitor.use_record(), time })
    }

    #[cfg(test)]
    pub(super) fn of(values: Vec<(Field, Known)>, rated: Rated) -> Self {
        Self { values, rated, use_record: UseRecord::default(), time: Timestamp::default() }
    }

    pub(super) fn rated(&self) -> Rated {
        self.rated
    }

    pub(super) fn use_record(&self) -> &UseRecord {
        &self.use_record
    }

    pub(super) fn events(&self) -> Vec<(String, Timestamp)> {
        let UseRecord { temperature_c, voltage_v, current_a, .. } = &self.use_record;
        let limits = [
            ("temperature above its limit", temperature_c.above),
            ("temperature below its limit", temperature_c.below),
            ("overcharge: cell voltage above its limit", voltage_v.above),
            ("deep discharge: cell voltage below its limit", voltage_v.below),
            ("charging current above its limit", current_a.below),
            ("discharging current above its limit", current_a.above),
        ];
        let counted = limits.into_iter().filter(|(_, limit)| limit.events > 0);
        let text = |what: &str, limit: LimitUse| format!("{what}: {} x, {:.0} s", limit.events, limit.beyond_s);
        counted.map(|(what, limit)| (text(what, limit), self.time)).collect()
    }

    /// Returns a value, or the reason why it is unknown.
    pub fn get(&self, field: Field) -> Result<Quantity, &str> {
        let found = self.values.iter().find(|(one, _)| *one == field);
        found.map_or(Err("not determined"), |(_, known)| known.as_ref().copied().map_err(String::as_str))
    }
}

fn is_date(time: Timestamp) -> bool {
    time.secs() >= FIRST_DATE_S
}

/// Returns the value. If its time is not a date, returns the reason why the value is unknown.
fn dated(quantity: Quantity) -> Known {
    if is_date(quantity.time) {
        return Ok(quantity);
    }
    Err("its time is unknown: the clock was not set when it was measured".to_owned())
}

/// Rejects a state that does not fit the configuration.
fn check_origin(state: &Snapshot, config: &Config) -> Result<(), String> {
    let sample = &config.monitor.sample;
    if let Some(module) = config.monitor.modules.first() {
        let name = &module.model.name;
        return Err(format!(
            "a pack with modules of other cells ({name}) has no passport: its values describe one kind of cell"
        ));
    }
    let (strings, series) = state.wiring();
    let counts = [
        ("estimated cells", state.cells(), usize::from(sample.cells)),
        ("parallel strings", usize::from(strings), usize::from(sample.strings)),
        ("cells in series", usize::from(series), usize::from(sample.series())),
    ];
    if let Some((name, found, configured)) = counts.into_iter().find(|(_, found, configured)| found != configured) {
        return Err(format!("the record has {found} {name}, the configuration has {configured}"));
    }
    let configured_ah = config.monitor.model.rated_capacity_ah;
    let other = |found: &f64| (found - configured_ah).abs() > RATED_TOLERANCE * configured_ah;
    match state.rated_capacity_ah().filter(other) {
        Some(found) => Err(format!(
            "the record is of cells of {found} Ah, the configuration has cells of {configured_ah} Ah (rated capacity)"
        )),
        None => Ok(()),
    }
}

struct Battery<'a> {
    record: &'a Record,
    config: &'a Config,
    model: &'a CellModel,
    /// Monitor restored from the state, at the time of the state.
    monitor: Monitor,
    /// Wall clock minus the clock of the inputs (ns).
    offset_ns: i64,
    series: f64,
    strings: f64,
}

impl<'a> Battery<'a> {
    fn new(record: &'a Record, config: &'a Config, model: &'a CellModel) -> Result<Self, String> {
        let Some((at_ns, snapshot)) = &record.state else {
            return Err("no state: the record contains no reading, or its state is damaged".to_owned());
        };
        if !is_date(Timestamp::from_nanos(*at_ns)) {
            return Err(
                "the record has no dates, and a passport's values need their time: the clock was not set, or the log \
                        counts from its own start (--start-times dates a CSV)"
                    .to_owned(),
            );
        }
        check_origin(snapshot, config)?;
        let time = snapshot.time;
        let mut monitor = Monitor::new(config.monitor.clone());
        let fits = monitor.restore((**snapshot).clone(), Downtime::AsStamped);
        fits.map_err(|error| format!("the state does not fit the configuration: {error}"))?;
        monitor.handle(&crate::monitor::Record::tick(time), &mut Outputs::default());
        let sample = &config.monitor.sample;
        let offset_ns = at_ns.saturating_sub(time.nanos());
        let (series, strings) = (f64::from(sample.series()), f64::from(sample.strings));
        Ok(Self { record, config, model, monitor, offset_ns, series, strings })
    }

    fn value(&self, field: Field, terms: &Terms, moved: &Known) -> Known {
        let rated_ah = self.rated_ah();
        match field {
            Field::CapacityThroughput => moved.clone(),
            Field::FullCycles => moved.clone().map(|moved| moved.times(1.0 / (2.0 * rated_ah))),
            Field::EnergyThroughput => self.moved_kwh(terms),
            Field::StateOfCharge => self.soc(),
            Field::Temperature => self.temperature(),
            Field::TimeHot => self.time_beyond(terms, |it| it.above, |limit| limit.beyond_s),
            Field::TimeCold => self.time_beyond(terms, |it| it.below, |limit| limit.beyond_s),
            Field::TimeHotCharging => self.time_beyond(terms, |it| it.above, |limit| limit.beyond_charging_s),
            Field::TimeColdCharging => self.time_beyond(terms, |it| it.below, |limit| limit.beyond_charging_s),
            Field::RemainingCapacity => self.capacity_ah(),
            Field::CapacityFade => {
                let of_rated = self.capacity_ah()?.times(100.0 / rated_ah);
                Ok(Quantity { value: 100.0 - of_rated.value, ..of_rated })
            }
            Field::CellResistanceIncrease => self.worst_resistance().map(Quantity::increase),
            Field::PackResistanceIncrease => self.mean_resistance().map(Quantity::increase),
            Field::CellResistance => Ok(self.worst_resistance()?.times(self.new_ohm()?)),
            Field::PackResistance => Ok(self.mean_resistance()?.times(self.series / self.strings * self.new_ohm()?)),
            Field::RemainingEnergy => self.energy_kwh(),
            Field::StateOfCertifiedEnergy => {
                let certified_kwh =
                    terms.certified_kwh.ok_or("the certified energy is not given (--certified-energy-kwh)")?;
                Ok(self.energy_kwh()?.times(100.0 / certified_kwh))
            }
        }
    }

    fn rated_ah(&self) -> f64 {
        self.strings * self.model.rated_capacity_ah
    }

    fn wall(&self, time: Timestamp) -> Timestamp {
        time.plus_nanos(self.offset_ns)
    }

    fn moved_ah(&self, terms: &Terms) -> Known {
        let now = self.wall(self.monitor.now());
        if let Some(value) = terms.moved_ah {
            return Ok(Quantity { value, std: None, time: now });
        }
        if let Some(gap) = &self.record.gap {
            return Err(format!("{gap}; --throughput-ah gives the battery's own counter"));
        }
        let Some(before_ah) = terms.moved_before_ah else {
            return Err("the charge moved before the record started is not given (--throughput-before-ah, 0 \
                        for a battery recorded since new)"
                .to_owned());
        };
        let (moved_ah, imbalance_h) = self.record.moved(self.strings);
        let capacity = &self.config.monitor.health.capacity;
        let offset_a =
            self.monitor.current_offset().map_or(self.strings * capacity.current_offset_std_a, |it| it.std());
        let std = (capacity.current_gain_std * moved_ah).hypot(offset_a * imbalance_h);
        let time = self.record.moved_until_ns.map_or(now, Timestamp::from_nanos);
        Ok(Quantity { value: before_ah + moved_ah, std: Some(std), time })
    }

    fn moved_kwh(&self, terms: &Terms) -> Known {
        let Some(energy) = &self.record.energy else {
            return Err("a store contains no voltages to integrate; a replay of the logs does".to_owned());
        };
        if let Some(gap) = self.record.gap.as_deref().or(energy.gap()) {
            return Err(gap.to_owned());
        }
        if terms.moved_before_ah != Some(0.0) {
            return Err("the record does not start with the new battery (--throughput-before-ah 0)".to_owned());
        }
        // If only the pack's total voltage is measured, one estimated cell represents all cells in series.
        let cells = self.series / f64::from(self.config.monitor.sample.cells);
        let value = 1e-3 * self.strings * cells * energy.energy_wh;
        let std = Some(self.config.monitor.health.capacity.current_gain_std * value);
        let time = energy.until.unwrap_or_else(|| self.wall(self.monitor.now()));
        Ok(Quantity { value, std, time })
    }

    fn check_trust(&self) -> Result<(), String> {
        let mut cells = (0..self.config.monitor.sample.cells).map(CellIndex);
        match cells.find(|&cell| !self.monitor.is_trusted(cell)) {
            None => Ok(()),
            Some(cell) => {
                Err(format!("the estimate of cell {} is not trusted: its voltages contradict it", cell.0 + 1))
            }
        }
    }

    fn soc(&self) -> Known {
        self.check_trust()?;
        let is_voltage = |channel: Channel| matches!(channel, Channel::CellVoltage(_) | Channel::PackVoltage);
        let voltages = self.monitor.latest_readings().filter(|(channel, ..)| is_voltage(*channel));
        // Each voltage channel has a latest reading. The oldest of these readings gives the time of the SOC.
        let oldest = voltages.map(|(_, time, _)| time).min();
        match (self.monitor.pack(), oldest) {
            (Some(pack), Some(time)) => {
                Ok(Quantity { value: 100.0 * pack.soc, std: Some(100.0 * pack.soc_std), time: self.wall(time) })
            }
            _ => Err("some cells have no estimate yet: their voltages have not been received".to_owned()),
        }
    }

    fn temperature(&self) -> Known {
        let is_sensor = |channel: Channel| matches!(channel, Channel::Temperature(_));
        let readings = self.monitor.latest_readings().filter(|(channel, ..)| is_sensor(*channel));
        let hottest = readings.max_by(|a, b| a.2.total_cmp(&b.2));
        let (_, time, value) = hottest.ok_or("no temperature sensor has given a valid reading")?;
        Ok(Quantity { value, std: None, time: self.wall(time) })
    }

    fn time_beyond(&self, terms: &Terms, side: fn(&RangeUse) -> LimitUse, seconds: fn(LimitUse) -> f64) -> Known {
        if terms.moved_before_ah != Some(0.0) {
            return Err("the record does not start with the new battery (--throughput-before-ah 0)".to_owned());
        }
        let record = self.monitor.use_record();
        let UseRecord { temperature_c, half_cycles, .. } = record;
        let limit = side(temperature_c);
        let counted = half_cycles.discharges.iter().sum::<u64>() + half_cycles.charges + half_cycles.unknown;
        if let Some(gap) = &self.record.gap {
            return Err(gap.clone());
        }
        if counted < self.record.half_cycles() {
            return Err("an earlier version of the program did not count the use".to_owned());
        }
        if limit.known_s == 0.0 {
            return Err("no temperature limit is configured ([outlook]), or no temperature was known".to_owned());
        }
        let unknown_s = record.unknown_s(&limit);
        if is_too_much(unknown_s, limit.known_s) {
            return Err(format!("the temperature, or its limit, was unknown for {unknown_s:.0} s of the record"));
        }
        Ok(Quantity { value: seconds(limit) / 60.0, std: None, time: self.wall(self.monitor.now()) })
    }

    fn learned(&self) -> Result<Vec<(usize, Learned)>, String> {
        self.check_trust()?;
        let of_cell = |index: usize| {
            let has_learned = self
                .monitor
                .cell_views()
                .nth(index)
                .is_some_and(|view| view.values.get(catalogue::Quantity::Capacity).is_some());
            let learned = self.record.cells.get(index).and_then(|cell: &CellRecord| cell.learned);
            learned.filter(|_| has_learned).map(|learned| (index, learned)).ok_or_else(|| {
                format!("nothing has been learned about cell {} yet: it needs a deep charge or discharge", index + 1)
            })
        };
        (0..usize::from(self.config.monitor.sample.cells)).map(of_cell).collect()
    }

    fn capacity_ah(&self) -> Known {
        let learned = self.learned()?;
        let weakest = learned.iter().min_by(|a, b| a.1.capacity.0.total_cmp(&b.1.capacity.0));
        let (_, Learned { at_ns, capacity: (mean, std), .. }) = weakest.ok_or("the pack has no cells")?;
        Ok(Quantity { value: *mean, std: Some(*std), time: Timestamp::from_nanos(*at_ns) }.times(self.strings))
    }

    fn worst_resistance(&self) -> Known {
        let learned = self.learned()?;
        let worst = learned.iter().max_by(|a, b| a.1.resistance.0.total_cmp(&b.1.resistance.0));
        let (_, Learned { at_ns, resistance: (mean, std), .. }) = worst.ok_or("the pack has no cells")?;
        Ok(Quantity { value: *mean, std: Some(*std), time: Timestamp::from_nanos(*at_ns) })
    }

    /// Returns the mean of the cells' resistance ratios. The standard deviation is the mean of the cells' standard
    /// deviations, because all cells share the error of the model.
    fn mean_resistance(&self) -> Known {
        let learned = self.learned()?;
        let count = learned.len() as f64;
        let mean = |pick: fn(&Learned) -> f64| learned.iter().map(|(_, learned)| pick(learned)).sum::<f64>() / count;
        let oldest_ns = learned.iter().map(|(_, learned)| learned.at_ns).min().ok_or("the pack has no cells")?;
        let (value, std) = (mean(|learned| learned.resistance.0), mean(|learned| learned.resistance.1));
        Ok(Quantity { value, std: Some(std), time: Timestamp::from_nanos(oldest_ns) })
    }

    /// Returns the series resistance of a new cell at SOC 0.5 and 25 degrees C (ohm).
    fn new_ohm(&self) -> Result<f64, String> {
        match self.monitor.model().state {
            ModelState::Given | ModelState::Learned => Ok(self.model.r0_ohm(&self.model.grid_position(0.5, 25.0))),
            ModelState::Prior | ModelState::Learning | ModelState::Unfit => Err(
                "the resistance of a new cell is unknown: there is no model file, and its own model is not learned yet"
                    .to_owned(),
            ),
        }
    }

    /// Returns the energy of a discharge at the configured load, from full until the weakest cell is empty (kWh).
    fn energy_kwh(&self) -> Known {
        let Some(load) = &self.config.monitor.health.usable else {
            return Err("no load is configured ([usable], the load of the certification)".to_owned());
        };
        self.new_ohm()?;
        let learned = self.learned()?;
        let usable = learned.iter().map(|(_, learned)| learned.usable).collect::<Option<Vec<_>>>();
        let usable = usable.ok_or("the usable capacity of a cell is unknown: it needs a discharge")?;
        let weakest = usable.iter().min_by(|a, b| a.1.0.total_cmp(&b.1.0));
        let (at_ns, (charge_ah, std_ah)) = *weakest.ok_or("the pack has no cells")?;
        let of_cell = |(_, cell): &(usize, Learned)| {
            Discharge::new(self.model, load, cell.capacity.0, cell.resistance.0).energy_wh(charge_ah)
        };
        let energy_wh = learned.iter().map(of_cell).sum::<f64>() / learned.len() as f64;
        let value = 1e-3 * energy_wh * self.series * self.strings;
        // The standard deviation contains only the uncertainty of the charge, because the mean voltage is accurate to
        // about one percent.
        let std = (charge_ah > 0.0).then(|| value * std_ah / charge_ah);
        Ok(Quantity { value, std, time: Timestamp::from_nanos(at_ns) })
    }
}

impl Quantity {
    fn times(self, factor: f64) -> Self {
        Self { value: factor * self.value, std: self.std.map(|std| factor * std), ..self }
    }

    /// Converts a ratio (relative to new) to an increase in percent.
    fn increase(self) -> Self {
        Self { value: 100.0 * (self.value - 1.0), std: self.std.map(|std| 100.0 * std), ..self }
    }
}
