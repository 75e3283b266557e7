//! The Python module `packwatch._packwatch`. Its classes and functions use the same library as the command line.
//!
//! Input: paths, and NumPy or Arrow arrays (seconds, A with positive = discharge, V, degrees C). Output: Arrow tables,
//! strings and dictionaries with the same content that the command line writes. Unknown values are null or NaN, never a
//! default number. Invalid input raises a Python exception (`packwatch._errors`) with the error message of the command
//! line. Long work runs without the interpreter's lock, and Ctrl-C stops it.
//!
//! | file | contents |
//! | --- | --- |
//! | `monitor.rs`, `replay.rs` | pass rows, frames and logs to the monitor |
//! | `outputs.rs`, `table.rs` | estimates, events and frames as Arrow tables |
//! | `score.rs`, `fit.rs`, `rul.rs`, `gp.rs` | the commands of these names |
//! | `cell_model.rs` | cell models |
//! | `measured.rs` | measured files |
//! | `arrays.rs` | arrays from Python |
//! | `error.rs` | exceptions |
//! | `arguments.rs` | shared arguments |
//! | `background_task.rs` | progress and Ctrl-C |
//! | `exclusive_state.rs` | one call of a monitor at a time |

mod arguments;
mod arrays;
mod background_task;
mod cell_model;
mod error;
mod exclusive_state;
mod fit;
mod gp;
mod measured;
mod monitor;
mod outputs;
mod replay;
mod rul;
mod score;
mod table;

use pyo3::prelude::*;

#[pymodule]
fn _packwatch(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("BDF_COLUMNS", packwatch_lab::measured::BDF_COLUMNS.to_vec())?;
    module.add_class::<cell_model::CellModel>()?;
    module.add_class::<fit::Fit>()?;
    module.add_class::<gp::GaussianProcess>()?;
    module.add_class::<monitor::Monitor>()?;
    module.add_class::<outputs::Outputs>()?;
    module.add_class::<replay::Replay>()?;
    module.add_class::<score::Score>()?;
    module.add_class::<table::Table>()?;
    module.add_function(wrap_pyfunction!(arrays::float64, module)?)?;
    module.add_function(wrap_pyfunction!(fit::fit, module)?)?;
    module.add_function(wrap_pyfunction!(measured::read, module)?)?;
    module.add_function(wrap_pyfunction!(replay::replay, module)?)?;
    module.add_function(wrap_pyfunction!(rul::rul, module)?)?;
    module.add_function(wrap_pyfunction!(score::score, module)?)?;
    Ok(())
}
