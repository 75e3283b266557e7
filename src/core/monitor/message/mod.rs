//! Inputs and outputs of the core: records and commands in; events, estimates and frames out. These types do not depend
//! on the stages.

mod command;
mod event;
mod learned_cell;
mod outputs;
mod record;
mod view;

pub use command::{Command, Source};
pub use event::{Event, EventKind, ModelState};
pub use learned_cell::LearnedCell;
pub use outputs::{Estimate, MeasuredValues, Outputs, Secured, Transmit, Validity};
pub use record::{BusEvent, Downtime, DowntimeParseError, MERGE_TOLERANCE_NS, Record, RecordKind, TICK_PERIOD_MS};
pub use view::{CellView, PackView};
