//! The doors: each takes any bytes, drives one entrance of the program with them and panics when an invariant does not hold.
//!
//! | door | entrance | invariants, besides "no panic" |
//! | --- | --- | --- |
//! | `core` | frames, ticks, gaps, commands, J1939, diagnostics into the monitor | only own identifiers are sent; estimates are numbers; an unknown value clears no alarm; a second run gives the same outputs |
//! | `cuts` | the same, with snapshots taken and restored in between | own state is accepted; frames, events and estimates are those without a cut, bit for bit |
//! | `snapshot` | a stored state with damaged numbers | rejected, or runs on with numbers, and its own state is accepted |
//! | `configuration` | TOML; numbers of any size in any key | accepted: runs, and accepts its own state |
//! | `cell_model` | a cell model file | as for `configuration` |
//! | `dbc` | a DBC file | what is written reads back the same |
//! | `log`, `journal` | candump logs, CSV, journals | one by one and in batches give the same records |
//! | `table` | measured CSV of `fit`, `rul`, `gpr` | rows are numbers |
//! | `obdb`, `bpx` | files of `import` | a cell model that is written is accepted |
//! | `control` | a line on the control socket | what is written reads back the same |
//! | `store` | a database with changed bytes | opens, or reports why; works again afterwards |

mod configuration;
mod core;
mod files;
mod snapshot;
mod source;
mod store;
mod texts;
mod world;

/// A door: any bytes in, a panic for a broken invariant.
pub type Door = fn(&[u8]);

/// Every door with its name, which is that of its fuzz target and of its folder of seeds.
pub const DOORS: &[(&str, Door)] = &[
    ("core", core::core),
    ("cuts", core::cuts),
    ("snapshot", snapshot::snapshot),
    ("configuration", configuration::configuration),
    ("cell_model", configuration::cell_model),
    ("dbc", texts::dbc),
    ("log", files::log),
    ("journal", files::journal),
    ("control", texts::control),
    ("store", store::store),
    #[cfg(feature = "lab")]
    ("table", files::table),
    #[cfg(feature = "lab")]
    ("obdb", texts::obdb),
    #[cfg(feature = "lab")]
    ("bpx", texts::bpx),
];

/// The door of a name.
///
/// # Panics
/// When there is none.
pub fn door(name: &str) -> Door {
    DOORS.iter().find(|(known, _)| *known == name).map_or_else(|| panic!("no door {name}"), |(_, door)| *door)
}
