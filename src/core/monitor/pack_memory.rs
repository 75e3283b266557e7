//! What was learned of the packs that were connected before, by their number, so that it is known again when one comes back.
//!
//! In: the parts of the state that belong to the connected pack, when readings begin to give another number; the new number,
//! once it is certain. Out: what is known of that pack. Kept are capacities, resistances, remaining lives, recharge periods and
//! the offset of the current (a pack often has its own sensor); not the half-cycle under way and not the state of charge, which
//! the first voltage decides. A pack of which nothing was learned is not kept, so that invented numbers displace none.

use serde::{Deserialize, Serialize};

use super::learning::LearningState;
use super::modelling::ModellingState;
use super::snapshot::StoredCell;
use crate::cell_faults::CellFaultDetector;
use crate::quantity::InvalidState;

/// Packs kept beside the connected one: more than a vehicle exchanges in turn.
const MAX_PACKS: usize = 8;
/// Cells of all of them together, but always one pack: a cell takes 2.6 kB of the stored state.
const MAX_CELLS: usize = 384;

/// The packs, the one connected least lately first.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub(super) struct PackMemory {
    packs: Vec<StoredPack>,
    /// The connected pack as it was before the first reading of another number.
    #[serde(skip)]
    pub(super) aside: Option<Box<StoredPack>>,
}

/// What was learned of one pack.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StoredPack {
    pub(super) number: f64,
    pub(super) cells: Vec<StoredCell>,
    /// What is learned of the cells' model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) modelling: Option<ModellingState>,
    /// What is known of single cells.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) diagnosis: Option<CellFaultDetector>,
    pub(super) learning: LearningState,
}

impl PackMemory {
    pub(super) fn is_empty(&self) -> bool {
        self.packs.is_empty()
    }

    /// Whether the connected pack is put aside.
    pub(super) fn has_aside(&self) -> bool {
        self.aside.is_some()
    }

    /// Puts the connected pack aside: its next voltages may be those of another.
    pub(super) fn put_aside(&mut self, pack: StoredPack) {
        self.aside = Some(Box::new(pack));
    }

    /// The number was that of the connected pack again, or what was learned of it does not hold.
    pub(super) fn drop_aside(&mut self) {
        self.aside = None;
    }

    /// Keeps the pack that was put aside, and takes out what is known of `number`.
    pub(super) fn exchange(&mut self, number: f64) -> Option<StoredPack> {
        let found = self.packs.iter().position(|pack| pack.number == number).map(|place| self.packs.remove(place));
        if let Some(pack) = self.aside.take().filter(|pack| pack.has_learned()) {
            self.packs.retain(|other| other.number != pack.number);
            let room = (MAX_CELLS / pack.cells.len().max(1)).clamp(1, MAX_PACKS);
            self.packs.drain(..(self.packs.len() + 1).saturating_sub(room));
            self.packs.push(*pack);
        }
        found
    }

    /// Forgets values that were measured by another window or load.
    pub(super) fn forget_measures(&mut self, is_other_recharge: bool, is_other_load: bool) {
        for pack in &mut self.packs {
            if is_other_recharge {
                (pack.learning.recharge_period_s, pack.learning.normalised_recharge) = (None, None);
            }
            if is_other_load {
                pack.cells.iter_mut().for_each(|cell| cell.health.usable = None);
            }
        }
    }

    /// Drops packs of another shape, from a stored state of another configuration.
    pub(super) fn retain(&mut self, fits: impl Fn(&StoredPack) -> bool) {
        self.packs.retain(fits);
    }

    /// Checks that every number is possible.
    pub(super) fn check(&self) -> Result<(), InvalidState> {
        for pack in &self.packs {
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
