//! The condition of a battery as a passport states it: every value with its time and standard deviation, or why it is not known.
//!
//! In: a [`Record`], the configuration, the cell model in force, and what only people know ([`Terms`]). A value is known when it
//! was measured or learned; a configured start value, an estimate that is not trusted and a sum with missing parts are not.

use super::energy::Discharge;
use super::field::Field;
use super::record::{CellRecord, Learned, Record};

use crate::cell::CellModel;
use crate::config::Config;
use crate::monitor::{Downtime, ModelState, Monitor, Outputs, Snapshot};
use crate::quantity::{CellIndex, Channel, Timestamp, catalogue};

/// Stamps before 2001-01-01, s since 1970, are no dates. A clock that was not set begins in 1970, 1980 or 2000; a log that counts from its
/// start is shorter than 30 years.
const FIRST_DATE_S: f64 = 978_307_200.0;
/// Largest difference between two statements about the new battery, fraction: they may be rounded.
pub(super) const RATED_TOLERANCE: f64 = 0.01;

/// What no record holds, from the command line. `None` = not given.
#[derive(Debug, Clone, Copy, Default)]
pub struct Terms {
    /// Charge that the battery had moved before the record began, Ah; 0 = it was recorded since new.
    pub moved_before_ah: Option<f64>,
    /// Charge that the battery has moved in all, Ah, as its own counter says: instead of the record's sum.
    pub moved_ah: Option<f64>,
    /// Usable energy at the certification, kWh.
    pub certified_kwh: Option<f64>,
}

/// A known value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Quantity {
    /// The value, in the unit of its field.
    pub value: f64,
    /// Its standard deviation; `None` = not known.
    pub std: Option<f64>,
    /// When it was determined.
    pub time: Timestamp,
}

/// A value, or why it is not known.
pub type Known = Result<Quantity, String>;

/// All values of a passport that packwatch can know.
#[derive(Debug)]
pub struct Condition {
    values: Vec<(Field, Known)>,
    rated: Rated,
}

/// What the configuration and the command line say of the new battery: a passport that says otherwise is of another one.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Rated {
    /// Capacity, Ah.
    pub(super) capacity_ah: Option<f64>,
    /// Energy at the certification, kWh.
    pub(super) energy_kwh: Option<f64>,
}

impl Condition {
    /// Determines all values.
    ///
    /// # Errors
    /// Without a state, with one that does not fit the configuration, or one without a date.
    pub fn new(record: &Record, config: &Config, model: &CellModel, terms: &Terms) -> Result<Self, String> {
        let battery = Battery::new(record, config, model)?;
        let moved = battery.moved_ah(terms);
        let values = Field::ALL.map(|field| (field, battery.value(field, terms, &moved).and_then(dated)));
        let rated = Rated { capacity_ah: Some(battery.rated_ah()), energy_kwh: terms.certified_kwh };
        Ok(Self { values: values.to_vec(), rated })
    }

    /// Values made for a test.
    #[cfg(test)]
    pub(super) fn of(values: Vec<(Field, Known)>, rated: Rated) -> Self {
        Self { values, rated }
    }

    /// What the new battery was.
    pub(super) fn rated(&self) -> Rated {
        self.rated
    }

    /// A value.
    pub fn get(&self, field: Field) -> Result<Quantity, &str> {
        let found = self.values.iter().find(|(one, _)| *one == field);
        found.map_or(Err("not determined"), |(_, known)| known.as_ref().copied().map_err(String::as_str))
    }
}

fn is_date(time: Timestamp) -> bool {
    time.secs() >= FIRST_DATE_S
}

/// A value with a real time.
fn dated(quantity: Quantity) -> Known {
    if is_date(quantity.time) {
        return Ok(quantity);
    }
    Err("its time is not known: the clock was not set when it was measured".to_owned())
}

/// Checks that a state was taken with this configuration of the pack. What a state of an earlier program does not say is not checked.
fn check_origin(state: &Snapshot, config: &Config) -> Result<(), String> {
    let sample = &config.monitor.sample;
    if let Some(module) = config.monitor.modules.first() {
        let name = &module.model.name;
        return Err(format!(
            "a pack with modules of other cells ({name}) has no passport: its values are of one kind of cell"
        ));
    }
    let (strings, series) = state.wiring();
    let counts = [
        ("estimated cells", state.cells(), usize::from(sample.cells)),
        ("parallel strings", usize::from(strings), usize::from(sample.strings)),
        ("cells in series", usize::from(series), usize::from(sample.series())),
    ];
    if let Some((name, found, configured)) = counts.into_iter().find(|(_, found, configured)| found != configured) {
        return Err(format!("the record is of {found} {name}, the configuration has {configured}"));
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

/// The sources of the values.
struct Battery<'a> {
    record: &'a Record,
    config: &'a Config,
    model: &'a CellModel,
    /// The state, restored at the time when it was taken.
    monitor: Monitor,
    /// Wall clock less the clock of the inputs, ns.
    offset_ns: i64,
    series: f64,
    strings: f64,
}

impl<'a> Battery<'a> {
    fn new(record: &'a Record, config: &'a Config, model: &'a CellModel) -> Result<Self, String> {
        let Some((at_ns, snapshot)) = &record.state else {
            return Err("no state: the record has no reading, or its state is damaged".to_owned());
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

    /// Determines a value.
    fn value(&self, field: Field, terms: &Terms, moved: &Known) -> Known {
        let rated_ah = self.rated_ah();
        match field {
            Field::CapacityThroughput => moved.clone(),
            Field::FullCycles => moved.clone().map(|moved| moved.times(1.0 / (2.0 * rated_ah))),
            Field::EnergyThroughput => self.moved_kwh(terms),
            Field::StateOfCharge => self.soc(),
            Field::Temperature => self.temperature(),
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

    /// Charge moved in all.
    fn moved_ah(&self, terms: &Terms) -> Known {
        let now = self.wall(self.monitor.now());
        if let Some(value) = terms.moved_ah {
            return Ok(Quantity { value, std: None, time: now });
        }
        if let Some(gap) = &self.record.gap {
            return Err(format!("{gap}; --throughput-ah gives the battery's own counter"));
        }
        let Some(before_ah) = terms.moved_before_ah else {
            return Err("the charge that the battery had moved before the record began is not given (--throughput-before-ah, 0 \
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
            return Err("a store keeps no voltages to integrate; a replay of the logs does".to_owned());
        };
        if let Some(gap) = self.record.gap.as_deref().or(energy.gap()) {
            return Err(gap.to_owned());
        }
        if terms.moved_before_ah != Some(0.0) {
            return Err("the record does not begin with the new battery (--throughput-before-ah 0)".to_owned());
        }
        // One estimated cell stands for all where only the pack's total is measured.
        let cells = self.series / f64::from(self.config.monitor.sample.cells);
        let value = 1e-3 * self.strings * cells * energy.energy_wh;
        let std = Some(self.config.monitor.health.capacity.current_gain_std * value);
        let time = energy.until.unwrap_or_else(|| self.wall(self.monitor.now()));
        Ok(Quantity { value, std, time })
    }

    /// Fails, with the cell, where an estimate is not trusted.
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
        // The pack is known as of its oldest voltage.
        let oldest = voltages.map(|(_, time, _)| time).min();
        match (self.monitor.pack(), oldest) {
            (Some(pack), Some(time)) => {
                Ok(Quantity { value: 100.0 * pack.soc, std: Some(100.0 * pack.soc_std), time: self.wall(time) })
            }
            _ => Err("not every cell has an estimate yet: their voltages have not all come".to_owned()),
        }
    }

    fn temperature(&self) -> Known {
        let is_sensor = |channel: Channel| matches!(channel, Channel::Temperature(_));
        let readings = self.monitor.latest_readings().filter(|(channel, ..)| is_sensor(*channel));
        let hottest = readings.max_by(|a, b| a.2.total_cmp(&b.2));
        let (_, time, value) = hottest.ok_or("no temperature sensor has given a good reading")?;
        Ok(Quantity { value, std: None, time: self.wall(time) })
    }

    /// What was learned of every cell.
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
                format!("nothing has been learned of cell {} yet: it needs a deep charge or discharge", index + 1)
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

    /// Resistance over new of the cell with the highest.
    fn worst_resistance(&self) -> Known {
        let learned = self.learned()?;
        let worst = learned.iter().max_by(|a, b| a.1.resistance.0.total_cmp(&b.1.resistance.0));
        let (_, Learned { at_ns, resistance: (mean, std), .. }) = worst.ok_or("the pack has no cells")?;
        Ok(Quantity { value: *mean, std: Some(*std), time: Timestamp::from_nanos(*at_ns) })
    }

    /// Mean of the cells' resistances over new. Their errors share the model's: the deviation is their mean too.
    fn mean_resistance(&self) -> Known {
        let learned = self.learned()?;
        let count = learned.len() as f64;
        let mean = |pick: fn(&Learned) -> f64| learned.iter().map(|(_, learned)| pick(learned)).sum::<f64>() / count;
        let oldest_ns = learned.iter().map(|(_, learned)| learned.at_ns).min().ok_or("the pack has no cells")?;
        let (value, std) = (mean(|learned| learned.resistance.0), mean(|learned| learned.resistance.1));
        Ok(Quantity { value, std: Some(std), time: Timestamp::from_nanos(oldest_ns) })
    }

    /// Series resistance of a new cell, ohm.
    fn new_ohm(&self) -> Result<f64, String> {
        match self.monitor.model().state {
            ModelState::Given | ModelState::Learned => Ok(self.model.r0_ohm(&self.model.grid_position(0.5, 25.0))),
            ModelState::Prior | ModelState::Learning | ModelState::Unfit => {
                Err("the resistance of a new cell is not known: no model file, and its own model is not learned yet"
                    .to_owned())
            }
        }
    }

    /// Energy of a discharge from full at the configured load until the weakest cell is empty.
    fn energy_kwh(&self) -> Known {
        let Some(load) = &self.config.monitor.health.usable else {
            return Err("no load is configured ([usable], the load of the certification)".to_owned());
        };
        self.new_ohm()?;
        let learned = self.learned()?;
        let usable = learned.iter().map(|(_, learned)| learned.usable).collect::<Option<Vec<_>>>();
        let usable = usable.ok_or("the usable capacity of a cell is not known: it needs a discharge")?;
        let weakest = usable.iter().min_by(|a, b| a.1.0.total_cmp(&b.1.0));
        let (at_ns, (charge_ah, std_ah)) = *weakest.ok_or("the pack has no cells")?;
        let of_cell = |(_, cell): &(usize, Learned)| {
            Discharge::new(self.model, load, cell.capacity.0, cell.resistance.0).energy_wh(charge_ah)
        };
        let energy_wh = learned.iter().map(of_cell).sum::<f64>() / learned.len() as f64;
        let value = 1e-3 * energy_wh * self.series * self.strings;
        // The charge carries the uncertainty: the mean voltage is known to about a per cent.
        let std = (charge_ah > 0.0).then(|| value * std_ah / charge_ah);
        Ok(Quantity { value, std, time: Timestamp::from_nanos(at_ns) })
    }
}

impl Quantity {
    fn times(self, factor: f64) -> Self {
        Self { value: factor * self.value, std: self.std.map(|std| factor * std), ..self }
    }

    /// A ratio to new as a gain in per cent.
    fn increase(self) -> Self {
        Self { value: 100.0 * (self.value - 1.0), std: self.std.map(|std| 100.0 * std), ..self }
    }
}
