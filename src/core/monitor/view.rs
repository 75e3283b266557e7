//! The present values of cells and pack for readers: status, tables, reports. `None` = not known (any more).

use super::Monitor;
use super::config::CommandConfig;
use super::message::{CellView, Estimate, PackView, ReportedState};
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
use crate::health::{InsufficientData, PackState, RemainingLife};
use crate::quantity::{BusIndex, CellIndex, Channel, Mode, Timestamp};
use crate::sample::{ReadingCounts, VoltageSource};

impl Monitor {
    /// Time of the latest input.
    pub fn now(&self) -> Timestamp {
        self.clock.now
    }

    /// Inputs with a time before that of an earlier one.
    pub fn time_backwards(&self) -> u64 {
        self.clock.time_backwards
    }

    /// Per protected input message: the count of each status of its check.
    pub fn protected(&self) -> impl Iterator<Item = GuardCounts> + '_ {
        self.intake.protected()
    }

    /// How commands from the bus are read; `None` = none are executed.
    pub fn commands(&self) -> Option<&CommandConfig> {
        self.config.commands.as_ref()
    }

    /// The authenticated command message, and how its frames were judged; `None` = commands are not authenticated.
    pub fn authenticated_commands(&self) -> Option<(BusIndex, CanId, CommandCounts)> {
        let commands = self.config.commands.as_ref().filter(|commands| commands.plan.authentication().is_some())?;
        Some((commands.bus, commands.plan.id(), self.intake.gate_of_commands.counts))
    }

    /// Input messages with dropped frames, because more came than the limit allows.
    pub fn dropped(&self) -> impl Iterator<Item = FloodCount> + '_ {
        self.intake.dropped()
    }

    /// Interfaces and input messages with a second sender.
    pub fn second_senders(&self) -> impl Iterator<Item = (BusIndex, CanId)> + '_ {
        self.intake.second_senders()
    }

    /// Interfaces on which another sender uses our own identifiers, with the latest of these.
    pub fn own_id_uses(&self) -> impl Iterator<Item = (BusIndex, CanId)> + '_ {
        self.intake.own_id_uses()
    }

    /// Whether the current's reading is frozen: the voltages show another load.
    pub fn is_current_frozen(&self) -> bool {
        self.stages.sampling.sampler.is_current_frozen()
    }

    /// What came from each controller that answers diagnostic requests.
    pub fn controllers(&self) -> impl Iterator<Item = ControllerCount> + '_ {
        self.intake.controllers()
    }

    /// How well the model of the cells is known.
    pub fn model(&self) -> ModelView<'_> {
        self.stages.modelling.view()
    }

    /// What is wrong with single cells.
    pub fn findings(&self) -> &[CellFault] {
        self.stages.findings.diagnosis.findings()
    }

    /// What is known of a cell's difference from its pack; `None` = the pack is too small for a comparison.
    pub fn difference(&self, cell: CellIndex) -> Option<&Difference> {
        self.stages.findings.diagnosis.difference(cell)
    }

    /// Why no diagnostic request is sent (`None` = they are), and how many are refused for good; `None` without `[poll]`.
    pub fn poll(&self) -> Option<(Option<PollSilence>, usize)> {
        self.stages.sending.poller.as_ref().map(|poller| (poller.silence(), poller.refused()))
    }

    /// Since when the buses sleep; `None` = they are awake.
    pub fn asleep_since(&self) -> Option<Timestamp> {
        self.stages.sleep.since
    }

    /// Readings by outcome.
    pub fn reading_counts(&self) -> ReadingCounts {
        self.stages.sampling.sampler.reading_counts()
    }

    /// Whether a usable reading has come since the first input. Values of a restored state do not count.
    pub fn has_heard(&self) -> bool {
        self.stages.sampling.has_usable_reading
    }

    /// Configured signals with a last good value that is too old: no reading came, or only bad ones. A signal without any
    /// reading is lost once it should have come.
    pub fn lost_inputs(&self) -> impl Iterator<Item = Channel> + '_ {
        let sampler = &self.stages.sampling.sampler;
        sampler.channels().iter().copied().filter(|&channel| sampler.is_lost(channel, self.now()))
    }

    /// The latest good reading of every signal that has had one, however old it is: channel, time, value.
    pub fn latest_readings(&self) -> impl Iterator<Item = (Channel, Timestamp, f64)> + '_ {
        self.stages.sampling.sampler.latest_readings()
    }

    /// Whether a cell's innovations agree with their covariance, and its model is not another cell's.
    pub fn is_trusted(&self, cell: CellIndex) -> bool {
        self.stages.estimation.is_trusted(cell.index())
    }

    /// How many signals are configured.
    pub fn inputs(&self) -> usize {
        self.stages.sampling.sampler.channels().len()
    }

    /// Identity of the connected pack; `None` = no signal is configured, or it has not been read yet.
    pub fn pack_identity(&self) -> Option<f64> {
        self.stages.sampling.identity.known
    }

    /// The latest estimate of every cell, for live tables; `None` before its first. Samples since the last
    /// [`settle`](Self::settle) are not in it.
    pub fn latest(&self) -> impl Iterator<Item = Option<Estimate>> {
        (0..self.stages.estimation.cells()).map(|index| self.stages.estimate(index))
    }

    /// The pack by its limiting cells; `None` before every cell has an estimate.
    pub fn pack(&self) -> Option<&PackState> {
        self.stages.learning.state.pack.as_ref()
    }

    /// Charge, rest or discharge.
    pub fn mode(&self) -> Mode {
        self.stages.learning.mode()
    }

    /// The last recorded recharge period, s.
    pub fn recharge_period_s(&self) -> Option<f64> {
        self.stages.learning.state.recharge_period_s
    }

    /// Time the reference charger needs for the window, s, after the last charge that covered enough of it.
    pub fn normalised_recharge_period(&self) -> Option<ScalarGaussian> {
        self.stages.learning.state.normalised_recharge
    }

    /// Usable capacity of a cell after its last half-cycle.
    pub fn usable_capacity(&self, cell: CellIndex) -> Option<ScalarGaussian> {
        self.stages.learning.cells.get(cell.index())?.usable
    }

    /// Published capacity of a cell.
    pub fn capacity(&self, cell: CellIndex) -> ScalarGaussian {
        self.stages.learning.capacity(cell.index())
    }

    /// Lithium and active material that a cell has lost; `None` = its capacity was not learned, or the cell model has no
    /// electrodes down to that capacity.
    pub fn loss_modes(&self, cell: CellIndex) -> Option<LossModes> {
        let Stages { estimation, learning, .. } = &self.stages;
        let has_learned = learning.state.learner.has_learned(cell.index());
        has_learned
            .then(|| learning.capacity(cell.index()))
            .and_then(|it| estimation.bank.model(cell.index()).loss_modes(it))
    }

    /// Offset of the current sensor, A of the pack: what it reads less the true current, positive = discharge. `None` =
    /// nothing learned yet.
    pub fn current_offset(&self) -> Option<ScalarGaussian> {
        let Stages { sampling, learning, .. } = &self.stages;
        let strings = f64::from(sampling.sampler.config().strings);
        let of_cell = learning.state.learner.current_offset().learned(learning.config.capacity.current_offset_std_a)?;
        Some(ScalarGaussian { mean: strings * of_cell.mean, variance: strings * strings * of_cell.variance })
    }

    /// Remaining life of a cell until its capacity passes the configured end of life.
    ///
    /// # Errors
    /// While too little is known.
    pub fn remaining_life(&self, cell: CellIndex) -> Result<RemainingLife, InsufficientData> {
        self.stages.learning.lives.of_cell(cell)
    }

    /// The cell whose life ends first, and when; `None` until every cell's is known.
    pub fn pack_remaining_life(&self) -> Option<(CellIndex, RemainingLife)> {
        self.stages.learning.lives.of_pack()
    }

    /// The alarm engine, with the raised alarms.
    pub fn alarms(&self) -> &AlarmEngine {
        &self.stages.alarming.engine
    }

    /// Counts since the first start.
    pub fn statistics(&self) -> &Statistics {
        &self.stages.statistics
    }

    /// Every cell as it is now.
    pub fn cell_views(&self) -> impl ExactSizeIterator<Item = CellView> + '_ {
        self.stages.estimation.cell_indices().map(|cell| self.cell_view(cell))
    }

    fn cell_view(&self, cell: CellIndex) -> CellView {
        let Stages { sampling, estimation, learning, .. } = &self.stages;
        let (sampler, channel, now) = (&sampling.sampler, sampling.voltage_channel(cell), self.now());
        let is_fresh = sampler.is_fresh(channel, now);
        let soc = estimation.bank.soc(cell.index()).filter(|_| is_fresh);
        let has_learned = learning.state.learner.has_learned(cell.index());
        CellView {
            cell,
            voltage_v: sampler.reported(channel, now).filter(|_| is_fresh),
            current_a: sampler.cell_current_a(now),
            temperature_c: sampler.temperature_c(cell, now),
            soc,
            capacity: has_learned.then(|| learning.capacity(cell.index())),
            usable_capacity: learning.cells[cell.index()].usable.filter(|_| has_learned),
            losses: self.loss_modes(cell),
            resistance_ratio: soc.map(|_| estimation.resistance(cell.index())),
            remaining_life: learning.lives.of_cell(cell),
            trusted: soc.map(|_| estimation.is_trusted(cell.index())),
        }
    }

    /// Sum of the cells' voltages, while all are fresh.
    fn pack_voltage_v(&self) -> Option<f64> {
        let sum_v: Option<f64> = self.cell_views().map(|view| view.voltage_v).sum();
        match self.stages.sampling.sampler.config().voltage_source {
            VoltageSource::Cells => sum_v,
            VoltageSource::PackTotal { series } => sum_v.map(|cell_v| cell_v * f64::from(series)),
        }
    }

    /// The pack as it is now.
    pub fn pack_view(&self) -> PackView {
        let Stages { sampling, estimation, learning, .. } = &self.stages;
        let (sampler, now, pack) = (&sampling.sampler, self.now(), self.pack());
        let health = learning.health_fields(&estimation.bank);
        let capacities = self.cell_views().filter_map(|view| view.capacity.map(|capacity| (view.cell, capacity)));
        let weakest = capacities.min_by(|a, b| a.1.mean.total_cmp(&b.1.mean));
        let hottest = sampler.hottest_c(now);
        PackView {
            validity: self.stages.validity(),
            mode: learning.mode(),
            soc: pack.map(|pack| ScalarGaussian::from_std(pack.soc, pack.soc_std)),
            limiting_cell: pack.map(|pack| pack.limiting_cell),
            voltage_v: self.pack_voltage_v(),
            current_a: sampler.pack_current_a(now),
            temperature_max_c: hottest.and_then(|(hottest_c, is_whole)| is_whole.then_some(hottest_c)),
            weakest: weakest.filter(|_| learning.state.learner.has_learned_all()),
            usable_capacity: health
                .usable_capacity_ah
                .zip(health.usable_capacity_std_ah)
                .map(|(mean, std)| ScalarGaussian::from_std(mean, std)),
            soh: health.soh,
            remaining_life: learning.lives.of_pack(),
            recharge_period_s: learning.state.recharge_period_s,
            normalised_recharge_period: learning.state.normalised_recharge,
            reported: ReportedState {
                soc: sampler.reported(Channel::ReportedSoc, now),
                soh: sampler.reported(Channel::ReportedSoh, now),
            },
        }
    }
}
