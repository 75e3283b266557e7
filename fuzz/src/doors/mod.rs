//! Fuzz entry points ("doors"). Each takes arbitrary bytes, feeds them to one input of the program, and panics if an
//! invariant is broken.
//!
//! | entry point | input of the program | invariants, in addition to "no panic" |
//! | --- | --- | --- |
//! | `core` | inputs of the monitor: frames, ticks, gaps, commands, J1939, diagnostics | only own identifiers are sent; estimates are finite; an unknown value never clears an alarm; a second run gives the same outputs |
//! | `cuts` | as for `core`, with snapshots taken and restored in between | the monitor accepts its own state; frames, events and estimates are bit-identical to a run without snapshots |
//! | `snapshot` | a stored state with damaged numbers | the state is rejected, or the monitor runs on with finite outputs and accepts the state that it then writes |
//! | `configuration` | TOML with numbers of any size in any key | with an accepted configuration, a monitor runs and accepts its own state |
//! | `cell_model` | a cell model file | with an accepted model, a monitor runs and accepts its own state |
//! | `dbc` | a DBC file | a written DBC reads back unchanged |
//! | `log`, `journal` | candump logs, CSV, journals | reading records one by one and in batches gives the same records |
//! | `formats` | logs of other tools | reading in small parts gives the same items; no item follows the end of the log |
//! | `table` | measured CSV of `fit`, `rul`, `gpr` | all rows have the same number of values |
//! | `obdb`, `bpx` | files of `import` | a cell model that is written from BPX is accepted |
//! | `control` | a line on the control socket | a written line reads back unchanged |
//! | `store` | a database or state file that is damaged or cut off | opening succeeds or reports a reason; a daemon can run on a store that opens |

mod configuration;
mod core;
mod files;
mod formats;
mod snapshot;
mod source;
mod store;
mod texts;
mod world;

/// An entry point: takes arbitrary bytes and panics if an invariant is broken.
pub type Door = fn(&[u8]);

/// All entry points by name. The fuzz target and the seed folder of an entry point have the same name.
pub const DOORS: &[(&str, Door)] = &[
    ("core", core::core),
    ("cuts", core::cuts),
    ("snapshot", snapshot::snapshot),
    ("configuration", configuration::configuration),
    ("cell_model", configuration::cell_model),
    ("dbc", texts::dbc),
    ("log", files::log),
    ("journal", files::journal),
    ("formats", formats::formats),
    ("control", texts::control),
    ("store", store::store),
    #[cfg(feature = "lab")]
    ("table", files::table),
    #[cfg(feature = "lab")]
    ("obdb", texts::obdb),
    #[cfg(feature = "lab")]
    ("bpx", texts::bpx),
];

/// Returns the entry point with this name.
///
/// # Panics
/// There is no entry point with this name.
pub fn door(name: &str) -> Door {
    DOORS
        .iter()
        .find(|(known, _)| *known == name)
        .map_or_else(|| panic!("unknown entry point {name}"), |(_, door)| *door)
}
