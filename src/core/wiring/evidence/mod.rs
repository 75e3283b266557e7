//! Evidence about signals from their values, names and bits. `doctor` judges the configured signals by this evidence,
//! and `discover` scores candidates.
//!
//! | file | purpose |
//! | --- | --- |
//! | `label` | names and units of signals: points for each quantity of a pack that a signal may be |
//! | `series` | statistics of one signal: counts, periods, extent, roughness |
//! | `sample` | extent of a stream of values, and every n-th value of it |
//! | `layout` | a signal read with another byte order, start bit or sign |
//! | `loss` | frames missing from a cyclic signal |
//! | `slope` | voltage over current: sign and size of the resistance |
//! | `response` | how the voltages of a pack follow its current: steps, steady runs, rests |
//! | `usage` | current, counted charge, voltage and reported values at the same times |
//! | `equal_cells` | cells that always have the same voltage |

mod equal_cells;
mod label;
pub(super) mod layout;
mod loss;
pub(super) mod response;
mod sample;
mod series;
mod slope;
pub(super) mod usage;

pub use label::{PackQuantity, Score, SignalLabel};
pub use sample::{Extent, ThinnedSample};
pub use series::{Series, UnusableCounts, recorded_value, windows};
pub use slope::Slope;
pub use usage::{HIDDEN_SOC, STEADY_A};
