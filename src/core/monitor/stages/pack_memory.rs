//! Stores the learned values of disconnected packs by pack number, and returns them when a pack is connected again.
//!
//! If a reading shows another pack number, the learned values of the connected pack are put aside. When further
//! readings confirm the new number, the values that were put aside are stored. If the memory already contains values of
//! the new pack, it returns them.
//!
//! The stored values are the cell model, capacities, resistances, remaining lives, recharge periods, findings and the
//! offset of the current sensor (a pack often has its own sensor). The unfinished half-cycle (charge or discharge) and
//! the state of charge are not stored; the first voltage determines the state of charge. A pack without learned values
//! is not stored, so that bogus pack numbers do not displace real packs.

use serde::{Deserialize, Serialize};

use crate::cell::{CellEstimator, CellState, ModelCheck, PackBank};
use crate::cell_faults::CellFaultDetector;
use crate::health::{Axis, Forecast};
use crate::monitor::stage::estimation::Consumed;
use crate::monitor::stage::learning::{CellHealth, LearningState, Throughput, check_positive};
use crate::monitor::stage::modelling::ModellingState;
use crate::quantity::{InvalidState, bounds};

/// Maximum number of stored packs, not counting the connected pack. Vehicles alternate between fewer packs than this.
const MAX_PACKS: usize = 8;
/// Maximum number of cells in all stored packs together. One pack is stored even if it has more cells. A cell takes
/// 2.6 kB of the stored state.
const MAX_CELLS: usize = 384;

/// Stored packs, least recently connected first.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PackMemory {
    packs: Vec<StoredPack>,
    /// Learned values of the connected pack, put aside because a reading showed another pack number.
    aside: Option<Box<StoredPack>>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct StoredPack {
    pub(crate) number: f64,
    pub(crate) cells: Vec<StoredCell>,
    pub(crate) modelling: Option<ModellingState>,
    pub(crate) diagnosis: Option<CellFaultDetector>,
    pub(crate) learning: LearningState,
}

/// One cell of a snapshot or of a stored pack.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct StoredCell {
    pub(crate) estimator: CellState,
    pub(crate) consumed: Option<Consumed>,
    pub(crate) trusted: bool,
    pub(crate) model_check: ModelCheck,
    #[serde(flatten)]
    pub(crate) health: CellHealth,
    pub(crate) forecast: Forecast,
    pub(crate) updated_in_round: bool,
}

impl PackMemory {
    pub(crate) fn has_aside(&self) -> bool {
        self.aside.is_some()
    }

    /// Puts the values of the connected pack aside, because the next voltages may belong to another pack.
    pub(crate) fn put_aside(&mut self, pack: StoredPack) {
        self.aside = Some(Box::new(pack));
    }

    /// Drops the values that were put aside. Called if the old number was read again, or if the learned values no
    /// longer apply.
    pub(crate) fn drop_aside(&mut self) {
        self.aside = None;
    }

    /// Stores the pack that was put aside. If a pack with `number` is stored, removes it from the memory and returns
    /// it.
    pub(crate) fn exchange(&mut self, number: f64) -> Option<StoredPack> {
        let found = self.packs.iter().position(|pack| pack.number == number).map(|place| self.packs.remove(place));
        if let Some(pack) = self.aside.take().filter(|pack| pack.has_learned()) {
            self.packs.retain(|other| other.number != pack.number);
            let room = (MAX_CELLS / pack.cells.len().max(1)).clamp(1, MAX_PACKS);
            self.packs.drain(..(self.packs.len() + 1).saturating_sub(room));
            self.packs.push(*pack);
        }
        found
    }

    /// If the recharge settings have changed, forgets the recharge periods. If the load has changed, forgets the usable
    /// capacities.
    pub(crate) fn forget_measures(&mut self, is_other_recharge: bool, is_other_load: bool) {
        for pack in &mut self.packs {
            if is_other_recharge {
                (pack.learning.recharge_period_s, pack.learning.normalised_recharge) = (None, None);
            }
            if is_other_load {
                pack.cells.iter_mut().for_each(|cell| cell.health.usable = None);
            }
        }
    }

    pub(crate) fn retain(&mut self, fits: impl Fn(&StoredPack) -> bool) {
        self.packs.retain(&fits);
        self.aside.take_if(|pack| !fits(pack));
    }

    pub(crate) fn check(&self) -> Result<(), InvalidState> {
        for pack in self.packs.iter().chain(self.aside.as_deref()) {
            InvalidState::unless(pack.number.is_finite(), "the number of a pack", pack.number, "a finite number")?;
            pack.learning.check()?;
            pack.modelling.iter().try_for_each(ModellingState::check)?;
            pack.diagnosis.iter().try_for_each(|diagnosis| diagnosis.check(pack.cells.len()))?;
            pack.cells.iter().try_for_each(StoredCell::check)?;
        }
        Ok(())
    }
}

impl StoredPack {
    fn has_learned(&self) -> bool {
        let mut cells = self.cells.iter().enumerate();
        cells
            .any(|(index, cell)| self.learning.learner.has_learned(index) || cell.health.discharge_resistance.is_some())
    }
}

impl StoredPack {
    /// Whether the pack has as many cells as the bank, and every cell [fits](StoredCell::fits).
    pub(crate) fn fits(&self, bank: &PackBank) -> bool {
        self.cells.len() == bank.cells()
            && self.learning.learner.fits(bank.cells())
            && self.cells.iter().enumerate().all(|(index, cell)| cell.fits(bank, index))
    }
}

impl StoredCell {
    pub(crate) fn check(&self) -> Result<(), InvalidState> {
        self.estimator.check()?;
        self.model_check.check()?;
        bounds::STORED_SOC.check("the SOC of a full cell", self.health.full_soc)?;
        check_positive("the usable capacity", self.health.usable)?;
        check_positive("the resistance after a discharge", self.health.discharge_resistance)?;
        let Throughput { charge_ah, charging_s, discharging_s } = self.health.throughput;
        InvalidState::unless_natural("the charge moved", charge_ah)?;
        bounds::TIME_S.check_all("the time of charges and discharges", [charging_s, discharging_s])?;
        self.forecast.check(Axis::Cycles)?;
        let Some(Consumed { charge_as, unmeasured_s, .. }) = self.consumed else { return Ok(()) };
        bounds::CHARGE_AS.check("the charge used by a cell's filter", charge_as)?;
        bounds::TIME_S.check("the unmeasured time used by a cell's filter", unmeasured_s)
    }

    /// Whether the stored filter has as many RC branches as the bank's model of this cell. A cell in a module (a group
    /// of cells of another type in the pack) always fits, even if the number of branches differs, because a module can
    /// be replaced without replacing the pack.
    pub(crate) fn fits(&self, bank: &PackBank, index: usize) -> bool {
        !bank.is_own(index) || CellEstimator::restore(&self.estimator, bank.model(index).branches.len()).is_some()
    }
}
