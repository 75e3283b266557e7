//! Methods of the monitor that return present values of the cells and the pack for status, tables and reports. `None`
//! means that a value is not known yet, or no longer known.

use super::Monitor;
use super::config::CommandConfig;
use super::message::{CellView, PackView};
use super::stage::intake::ControllerCount;
use super::stage::intake::command_gate::CommandCounts;
use super::stage::modelling::ModelView;
use super::stage::statistics::Statistics;
use super::stages::Stages;
use crate::alarm::AlarmEngine;
use crate::can::CanId;
use crate::can::flood::FloodCount;
use crate::can::guard::GuardCounts;
use crate::can::poll::PollSilence;
use crate::cell::LossModes;
use crate::cell_faults::{CellFault, Difference};
use crate::filter::ScalarGaussian;
use crate::health::{InsufficientData, PackState, RemainingLife, UseRecord};
use crate::quantity::catalogue::{CellValues, Estimate, PackValues, Quantity, RECORDED, Values};
use crate::quantity::{BusIndex, CellIndex, Channel, Mode, Timestamp};
use crate::sample::ReadingCounts;

/// Half the width of the 95 % interval, in standard deviations.
const Z95: f64 = 1.96;

impl Monitor {
    /// Time of the latest input.
    pub fn now(&self) -> Timestamp {
        self.clock.now
    }

    /// Number of inputs whose time was before the time of the latest input.
    pub fn time_backwards(&self) -> u64 {
        self.clock.time_backwards
    }

    /// Results of the end-to-end check, counted for each protected input message.
    pub fn protected(&self) -> impl Iterator<Item = GuardCounts> + '_ {
        self.intake.protected()
    }

    /// Configuration of commands from the bus; `None` = commands from the bus are not executed.
    pub fn commands(&self) -> Option<&CommandConfig> {
        self.config.commands.as_ref()
    }

    /// The authenticated command message (interface, identifier) and the results of checking its frames. `None` if
    /// commands are not authenticated.
    pub fn authenticated_commands(&self) -> Option<(BusIndex, CanId, CommandCounts)> {
        let commands = self.config.commands.as_ref().filter(|commands| commands.plan.authentication().is_some())?;
        Some((commands.bus, commands.plan.id(), self.intake.command_gate.counts))
    }

    /// Input messages that exceeded the rate limit, with the number of dropped frames.
    pub fn dropped(&self) -> impl Iterator<Item = FloodCount> + '_ {
        self.intake.dropped()
    }

    /// Input messages with a second sender: interface and identifier.
    pub fn second_senders(&self) -> impl Iterator<Item = (BusIndex, CanId)> + '_ {
        self.intake.second_senders()
    }

    /// Interfaces on which another node uses an identifier of the daemon, and the latest such identifier.
    pub fn own_id_uses(&self) -> impl Iterator<Item = (BusIndex, CanId)> + '_ {
        self.intake.own_id_uses()
    }

    /// Whether the reading of the current is frozen while the voltages show a changing load.
    pub fn is_current_frozen(&self) -> bool {
        self.stages.sampling.sampler.is_current_frozen()
    }

    /// Counts per controller that answers diagnostic requests.
    pub fn controllers(&self) -> impl Iterator<Item = ControllerCount> + '_ {
        self.intake.controllers()
    }

    /// State of the cell model.
    pub fn model(&self) -> ModelView<'_> {
        self.stages.modelling.view()
    }

    /// Findings of the cell-fault detector.
    pub fn findings(&self) -> &[CellFault] {
        self.stages.findings.diagnosis.findings()
    }

    /// A cell's difference from the other cells; `None` if the cell is not compared with them.
    pub fn difference(&self, cell: CellIndex) -> Option<&Difference> {
        self.stages.findings.diagnosis.difference(cell)
    }

    /// Reason why the daemon sends no diagnostic requests (`None` if it sends them), and number of requests that are
    /// never sent again. The whole result is `None` without `[poll]`.
    pub fn poll(&self) -> Option<(Option<PollSilence>, usize)> {
        self.stages.sending.poller.as_ref().map(|poller| (poller.silence(), poller.refused()))
    }

    /// Start of the present bus sleep; `None` if the buses are awake.
    pub fn asleep_since(&self) -> Option<Timestamp> {
        self.stages.sleep.since
    }

    /// Number of readings by outcome.
    pub fn reading_counts(&self) -> ReadingCounts {
        self.stages.sampling.sampler.reading_counts()
    }

    /// Whether a usable reading has arrived since the first input. Values of a restored state do not count.
    pub fn has_usable_reading(&self) -> bool {
        self.stages.sampling.has_usable_reading
    }

    /// Configured signals whose last good value is too old, because no reading arrived or all readings were bad. If a
    /// signal has never had a reading, its age counts from the start or the last waking.
    pub fn lost_inputs(&self) -> impl Iterator<Item = Channel> + '_ {
        let sampler = &self.stages.sampling.sampler;
        sampler.channels().iter().copied().filter(|&channel| sampler.is_lost(channel, self.now()))
    }

    /// Channel, time and value of the latest good reading of every signal, at any age. Omits signals without a good
    /// reading.
    pub fn latest_readings(&self) -> impl Iterator<Item = (Channel, Timestamp, f64)> + '_ {
        self.stages.sampling.sampler.latest_readings()
    }

    /// Whether a cell's innovations agree with their covariance and its model fits the cell.
    pub fn is_trusted(&self, cell: CellIndex) -> bool {
        self.stages.estimation.is_trusted(cell.index())
    }

    /// Number of configured signals.
    pub fn inputs(&self) -> usize {
        self.stages.sampling.sampler.channels().len()
    }

    /// Identity of the connected pack; `None` if no identity signal is configured or the signal has not been read yet.
    pub fn pack_identity(&self) -> Option<f64> {
        self.stages.sampling.identity.known
    }

    /// The latest estimate of every cell; `None` before a cell's first estimate. Samples that wait for the filter are
    /// not included; call [`settle`](Self::settle) first to include them.
    pub fn latest(&self) -> impl Iterator<Item = Option<super::Estimate>> {
        (0..self.stages.estimation.cells()).map(|index| self.stages.estimate(index))
    }

    /// Values of the pack; `None` unless every cell has an estimate and a fresh voltage.
    pub fn pack(&self) -> Option<&PackState> {
        self.stages.learning.state.pack.as_ref()
    }

    /// Operating mode of the pack.
    pub fn mode(&self) -> Mode {
        self.stages.learning.mode()
    }

    /// The last recorded recharge period (s): time that a charge took between two configured SOC values.
    pub fn recharge_period_s(&self) -> Option<f64> {
        self.stages.learning.state.recharge_period_s
    }

    /// Time (s) that the reference charger needs for the recharge window (a configured SOC range). Learned from the
    /// last charge that covered enough of the window.
    pub fn normalised_recharge_period(&self) -> Option<ScalarGaussian> {
        self.stages.learning.state.normalised_recharge
    }

    /// Usable capacity of a cell (Ah), updated after every discharge. The first value may come from a charge.
    pub fn usable_capacity(&self, cell: CellIndex) -> Option<ScalarGaussian> {
        self.stages.learning.cells.get(cell.index())?.usable
    }

    /// Learned capacity of a cell (Ah); before the first learning step, the model's capacity.
    pub fn capacity(&self, cell: CellIndex) -> ScalarGaussian {
        self.stages.learning.capacity(cell.index())
    }

    /// Lithium and active material that a cell has lost. `None` if its capacity has not been learned, or if the cell
    /// model has no electrode data down to that capacity.
    pub fn loss_modes(&self, cell: CellIndex) -> Option<LossModes> {
        let Stages { estimation, learning, .. } = &self.stages;
        let has_learned = learning.state.learner.has_learned(cell.index());
        has_learned
            .then(|| learning.capacity(cell.index()))
            .and_then(|it| estimation.bank.model(cell.index()).loss_modes(it))
    }

    /// Offset of the pack's current sensor (A): reading minus true current, positive = discharge. `None` until an
    /// offset has been learned.
    pub fn current_offset(&self) -> Option<ScalarGaussian> {
        let Stages { sampling, learning, .. } = &self.stages;
        let strings = f64::from(sampling.sampler.config().strings);
        let of_cell = learning.state.learner.current_offset().learned(learning.config.capacity.current_offset_std_a)?;
        Some(ScalarGaussian { mean: strings * of_cell.mean, variance: strings * strings * of_cell.variance })
    }

    /// Remaining life of a cell until its capacity falls below the configured end of life.
    ///
    /// # Errors
    /// The reason why the remaining life is unknown.
    pub fn remaining_life(&self, cell: CellIndex) -> Result<RemainingLife, InsufficientData> {
        self.stages.learning.lives.of_cell(cell)
    }

    /// The cell with the shortest remaining life, and that life; `None` until every cell's life is known.
    pub fn pack_remaining_life(&self) -> Option<(CellIndex, RemainingLife)> {
        self.stages.learning.lives.of_pack()
    }

    /// Counters of how the connected pack was used.
    pub fn use_record(&self) -> &UseRecord {
        self.stages.learning.state.use_counter.record()
    }

    /// The alarm engine with the raised alarms.
    pub fn alarms(&self) -> &AlarmEngine {
        &self.stages.alarming.engine
    }

    /// Counts since the first start.
    pub fn statistics(&self) -> &Statistics {
        &self.stages.statistics
    }

    /// Present values of every cell.
    pub fn cell_views(&self) -> impl ExactSizeIterator<Item = CellView> + '_ {
        self.stages.estimation.cell_indices().map(|cell| self.cell_view(cell))
    }

    fn cell_view(&self, cell: CellIndex) -> CellView {
        let Stages { sampling, estimation, learning, .. } = &self.stages;
        let (sampler, channel, now) = (&sampling.sampler, sampling.voltage_channel(cell), self.now());
        let is_fresh = sampler.is_fresh(channel, now);
        let soc = estimation.bank.soc(cell.index()).filter(|_| is_fresh);
        let has_learned = learning.state.learner.has_learned(cell.index());
        let life = learning.lives.of_cell(cell);
        let mut values = CellValues::default();
        values.set(Quantity::Voltage, sampler.reported(channel, now).filter(|_| is_fresh));
        values.set(Quantity::Current, sampler.cell_current_a(now));
        values.set(Quantity::Temperature, sampler.temperature_c(cell, now));
        values.set(Quantity::Soc, soc);
        let resistance = estimation.resistance(cell.index());
        let recorded = learning.cells[cell.index()].recorded(learning.capacity(cell.index()), resistance);
        for quantity in RECORDED {
            values.set(quantity, recorded.get(quantity).filter(|_| has_learned));
        }
        values.set(Quantity::ResistanceRatio, soc.map(|_| resistance));
        set_losses(&mut values, self.loss_modes(cell));
        set_remaining_life(&mut values, life.ok());
        CellView {
            cell,
            values,
            remaining_unknown: life.err().map(|why| why.to_string()),
            trusted: soc.map(|_| estimation.is_trusted(cell.index())),
        }
    }

    /// Present values of the pack.
    pub fn pack_view(&self) -> PackView {
        let Stages { sampling, estimation, learning, .. } = &self.stages;
        let (sampler, now, pack) = (&sampling.sampler, self.now(), self.pack());
        let health = learning.health_fields(&estimation.bank);
        let weakest = learning.weakest();
        let weakest_cell = weakest.and_then(|(index, _)| estimation.cell_indices().nth(index));
        let capacity = weakest.map(|(_, capacity)| capacity);
        let sensors = sampler.temperature_range_c(now);
        let soc = pack.map(|pack| ScalarGaussian::from_std(pack.soc, pack.soc_std));
        let edge = |sign: f64| soc.map(|soc| (soc.mean + sign * Z95 * soc.std()).clamp(0.0, 1.0));
        let usable = health.usable_capacity_ah.zip(health.usable_capacity_std_ah);
        let soh = health.soh.map(|mean| {
            let relative_std = capacity.map(|ah| ah.std() / ah.mean);
            Estimate { mean, std: relative_std.map(|std| mean * std) }
        });
        let life = learning.lives.of_pack();
        let model = self.model();
        let mut values = PackValues::default();
        values.set(Quantity::Soc, soc);
        values.set(Quantity::SocLow, edge(-1.0));
        values.set(Quantity::SocHigh, edge(1.0));
        values.set(Quantity::ReportedSoc, sampler.reported(Channel::ReportedSoc, now));
        values.set(Quantity::Voltage, sampling.pack_voltage_v(estimation.cell_indices(), now));
        values.set(Quantity::Current, sampler.pack_current_a(now));
        values.set(Quantity::CurrentOffset, self.current_offset());
        values.set(Quantity::TemperatureMax, sensors.filter(|it| it.is_whole).map(|it| it.highest));
        values.set(Quantity::Capacity, capacity);
        values.set(Quantity::UsableCapacity, usable.map(|(mean, std)| Estimate { mean, std: Some(std) }));
        values.set(Quantity::Soh, soh);
        values.set(Quantity::ReportedSoh, sampler.reported(Channel::ReportedSoh, now));
        values.set(Quantity::RechargePeriod, learning.state.recharge_period_s);
        values.set(Quantity::NormalisedRechargePeriod, learning.state.normalised_recharge);
        set_losses(&mut values, weakest_cell.and_then(|cell| self.loss_modes(cell)));
        set_remaining_life(&mut values, life.map(|(_, life)| life));
        values.set(Quantity::EnergySoh, self.stages.energy_soh());
        let power_limiting_cells = self.stages.set_outlook(&mut values);
        set_use(&mut values, self.use_record());
        PackView {
            validity: self.stages.validity(),
            mode: learning.mode(),
            limiting_cell: pack.map(|pack| pack.limiting_cell),
            power_limiting_cells,
            weakest_cell,
            shortest_lived_cell: life.map(|(cell, _)| cell),
            model_state: Some(model.state),
            model_fits_better: model.chemistry,
            moved: Some(learning.state.moved.sums),
            use_record: Some(*self.use_record()),
            values,
        }
    }
}

/// Sets the counters of use. A counter is unknown until the values that it depends on have been measured.
fn set_use(values: &mut PackValues, record: &UseRecord) {
    let UseRecord { temperature_c, voltage_v, current_a, half_cycles, rest, .. } = record;
    let is_judged = [temperature_c, voltage_v, current_a].iter().all(|it| it.below.known_s + it.above.known_s > 0.0);
    let number = |count: u64, is_known: bool| is_known.then_some(count as f64);
    values.set(Quantity::LimitEvents, number(record.events(), is_judged));
    values.set(Quantity::FastCharges, number(half_cycles.fast_charges, half_cycles.charges > 0));
    values.set(Quantity::HighSocTime, (rest.known_s > 0.0).then_some(rest.above_80_s));
}

fn set_losses<const IS_PACK: bool>(values: &mut Values<IS_PACK>, losses: Option<LossModes>) {
    values.set(Quantity::LithiumLoss, losses.map(|losses| losses.lithium));
    values.set(Quantity::NegativeLoss, losses.map(|losses| losses.negative));
    values.set(Quantity::PositiveLoss, losses.map(|losses| losses.positive));
}

fn set_remaining_life<const IS_PACK: bool>(values: &mut Values<IS_PACK>, life: Option<RemainingLife>) {
    let (cycles, days) = (life.and_then(|life| life.cycles), life.and_then(|life| life.days));
    values.set(Quantity::RemainingCycles, cycles.map(|cycles| cycles.median));
    values.set(Quantity::RemainingCyclesLow, cycles.map(|cycles| cycles.low));
    values.set(Quantity::RemainingCyclesHigh, cycles.map(|cycles| cycles.high));
    values.set(Quantity::RemainingDays, days.map(|days| days.median));
}
