//! Declares the tables of the vehicle, its pack and interfaces, the alarms and the store.

use super::choices::TEMPERATURE_C;
use crate::alarm::{Comparison, Rule};
use crate::cell::Chemistry;
use crate::config::schema::key::Presence::{Default, Optional, Required};
use crate::config::schema::key::ValueRange::{Above, Any, Between, NotEmpty};
use crate::config::schema::key::within;
use crate::config::schema::section::section;
use crate::config::schema::setting::CellRanges;
use crate::config::schema::threshold::Threshold;
use crate::quantity::{MAX_CELLS, bounds};

section! {
    /// Names the vehicle and pack in status, metrics, events, reports and history. Each value may have up to 64 characters. A change requires a restart.
    Vehicle at "vehicle" {
        /// Name of the vehicle.
        name: Option<String>, "", NotEmpty, Optional("none");
        /// Vehicle identification number or fleet number.
        id: Option<String>, "", NotEmpty, Optional("none");
        /// Name of the pack, for a vehicle with several packs.
        pack: Option<String>, "", NotEmpty, Optional("none");
    }
}

section! {
    /// The pack: number, connection and type of its cells.
    Pack at "pack" {
        /// Number of cells in series. Parallel cells that share one voltage tap count as one cell.
        cells: u16, "", Between(1.0, MAX_CELLS as f64), Required;
        /// Number of parallel strings. Each is assumed to carry an equal share of the pack current.
        strings: u16, "", Between(1.0, 1024.0), Default("1");
        /// Cell model file, relative to this file.
        cell_model: Option<String>, "", NotEmpty, Optional("a model made from `chemistry` and `rated_capacity_ah`");
        /// Chemistry of a cell without a model file. Estimates start from values typical of this chemistry, and their intervals cover the differences between such cells. "lmo-graphite" means the blend with a layered oxide used in early electric cars. Use "nmc-graphite" if the nickel content is unknown. `-graphite` may be left out.
        chemistry: Option<Chemistry>, "", Any, Optional("required without `cell_model`");
        /// Prior of a fleet, written by `packwatch fleet prior`, relative to this file. Estimates then start from what other vehicles have learned about cells with the same chemistry, rated capacity and voltages, instead of values typical of the chemistry.
        prior: Option<String>, "", NotEmpty, Optional("values typical of `chemistry`");
        /// Whether the daemon learns the model of cells without a model file on board, from drives, charges and rests.
        learn_model: bool, "", Any, Default("true");
        /// Whether the BMS balances, that is, discharges the fuller cells near and after the end of a charge. If it does, only the cell with the least charge can be recognised as leaking, unless `[input.balancing]` shows which cells are bled.
        balancing: bool, "", Any, Default("true");
        /// Lowest voltage (empty) of a cell without a model file.
        voltage_min_v: Option<f64>, "V", Above(0.0, 100.0), Optional("usual value of the chemistry: 2.5 V for NMC, NCA and LFP, else 3.0 V");
        /// Highest voltage (full) of a cell without a model file.
        voltage_max_v: Option<f64>, "V", Above(0.0, 100.0), Optional("usual value of the chemistry: 3.65 V for LFP, else 4.2 V");
        /// Rated capacity of one cell, as on its label. SOH is relative to it.
        rated_capacity_ah: Option<f64>, "Ah", within(bounds::CONFIGURED_CAPACITY_AH), Optional("the cell model's");
        /// Initial capacity of a cell, used until a capacity is learned.
        initial_capacity_ah: Option<f64>, "Ah", within(bounds::CONFIGURED_CAPACITY_AH), Optional("the cell model's `capacity_ah`");
        /// Standard deviation of the initial capacity.
        initial_capacity_std_ah: Option<f64>, "Ah", Above(0.0, 1e5), Optional("10 % of the initial capacity");
        /// Ambient temperature, used for cells without a sensor.
        ambient_c: f64, "degrees C", TEMPERATURE_C, Default("25.0");
    }
}

section! {
    /// Cells that differ from the rest of the pack, such as a replaced module or one from another manufacturer. They have their own cell model, which is not learned on board, and are not compared with the other cells.
    PackModule at "pack.module" {
        /// Cells of the module.
        cells: CellRanges, "", Any, Required;
        /// Cell model file, relative to this file.
        cell_model: Option<String>, "", NotEmpty, Optional("a model made from `chemistry` and `rated_capacity_ah`");
        /// Chemistry of a cell without a model file, as for `[pack]`.
        chemistry: Option<Chemistry>, "", Any, Optional("required without `cell_model`");
        /// Rated capacity of one cell, as on its label. SOH is relative to it.
        rated_capacity_ah: Option<f64>, "Ah", within(bounds::CONFIGURED_CAPACITY_AH), Optional("the cell model's");
        /// Initial capacity of a cell, used until a capacity is learned.
        initial_capacity_ah: Option<f64>, "Ah", within(bounds::CONFIGURED_CAPACITY_AH), Optional("the cell model's `capacity_ah`");
        /// Standard deviation of the initial capacity.
        initial_capacity_std_ah: Option<f64>, "Ah", Above(0.0, 1e5), Optional("10 % of the initial capacity");
    }
}

section! {
    /// A CAN interface. Interfaces are numbered in the order of the file.
    Interface at "interface" {
        /// Kernel name, up to 15 characters.
        name: String, "", NotEmpty, Required;
        /// Whether CAN FD frames are accepted and may be sent.
        fd: bool, "", Any, Default("false");
    }
}

section! {
    /// The alarms of a rule. The rules compare the following values.
    /// `capacity_low` and `usable_capacity_low`: capacity per cell (Ah). `recharge_period_low`: recharge period (s). `resistance_high`: resistance relative to a new cell (1 = as new).
    /// `soc_low`: SOC of the emptiest cell, fraction. `cell_imbalance`: SOC of the fullest cell minus SOC of the emptiest cell, fraction. `bms_disagrees`: SOC or SOH reported by the pack minus the estimate, fraction. `input_implausible`: share of bad readings, fraction.
    /// `temperature_high`: temperature of the hottest sensor (degrees C). `remaining_life_low`: remaining life, equivalent full cycles.
    /// `input_missing`, `store_failed` and `bus_fault`: how long the fault has lasted (s). `estimate_untrusted`: the mean normalised innovation squared, or the cell model's mismatch on the same scale.
    /// Three rules compare each cell with the other cells. `cell_leak`: self-discharge per day as a fraction of the cell's capacity. `connection_resistance`: additional contact resistance as a fraction of the cell's series resistance at 50 % SOC and 25 degrees C. `channel_faulty`: 1 while the cell's voltage channel is faulty (frozen, offset, doubled or swapped), else 0.
    /// `thermal_event`: 1 if the voltage of a cell collapses, 2 if a temperature of the cell rises faster than the current explains, 3 if both, else 0.
    Alarm at "alarm" {
        /// What the alarm compares.
        rule: Rule, "", Any, Required;
        /// Threshold of severity "info". The alarm is raised when the value is below it (rules `*_low`) or above it (all others). A number is in the rule's unit. A string like "80 %" is relative to the value of a new cell: its rated capacity, its recharge period with the reference charger, or its resistance. For fractions, 100 % is 1. With `{ set = ..., clear = ... }` the alarm clears at `clear`. At least one of `info`, `warning` and `severe` is required, and each severity may be set once per rule.
        info: Option<Threshold>, "the rule's unit", Between(-1e9, 1e9), Optional("no such alarm");
        /// Threshold of severity "warning", written like `info`.
        warning: Option<Threshold>, "the rule's unit", Between(-1e9, 1e9), Optional("no such alarm");
        /// Threshold of severity "severe", written like `info`.
        severe: Option<Threshold>, "the rule's unit", Between(-1e9, 1e9), Optional("no such alarm");
        /// If the threshold has no `clear`, the alarm clears when the value is back on the healthy side by this much. An alarm on a learned value also waits until the true value is on the healthy side with a probability of 95 %.
        hysteresis: Option<f64>, "the rule's unit", Between(0.0, 1e9), Optional("2 % of the threshold");
        /// What is compared with the threshold. "mean": the value itself. `{ probability = 0.95 }`: the alarm is raised when the true value is beyond the threshold with more than this probability. The alarm clears when the probability that the true value is beyond the clear threshold is at most this probability or 0.5, whichever is smaller. With a probability above 0.5, the alarm is raised later and false alarms are rarer. With a probability below 0.5, the alarm is raised earlier.
        when: Comparison, "", Any, Default("\"mean\"");
        /// The value must be beyond the threshold for this long before the alarm is raised, and healthy for this long before it clears.
        debounce_s: f64, "s", Between(0.0, 1e9), Default("0.0");
        /// Number of consecutive new values that must agree before the alarm is raised or cleared.
        debounce_events: u32, "", Between(1.0, 1e6), Default("1");
        /// Whether the alarm stays raised until a command clears it, even if the value is healthy again.
        latched: Option<bool>, "", Any, Optional("true for `thermal_event`, else false");
        /// J1939: suspect parameter number.
        spn: Option<u32>, "", Between(1.0, 524_287.0), Optional("520192 (manufacturer-assignable) plus the rule's number");
        /// J1939: failure mode identifier. The defaults for info, warning and severe are 17, 18 and 1 for a low value, and 15, 16 and 0 for a high value. Some rules have one default for all severities: 9 (missing input), 2 (implausible input, disagreeing pack, faulty channel), 19 (bus fault) and 31 (untrusted estimate, failed store, thermal event).
        fmi: Option<u8>, "", Between(0.0, 31.0), Optional("by rule and severity");
    }
}

section! {
    /// State and history on disk (`run --state`). Learned values are stored as soon as they are reported, independently of these keys.
    Store at "store" {
        /// Shortest time between checkpoints of the running state. A power cut loses the changes of this state since the last checkpoint; a restart of the service loses one second. Each checkpoint writes the whole state, about 70 kB for a pack of 96 cells. The time is extended so that at most 15 MB are written per day (7 minutes for such a pack).
        checkpoint_s: f64, "s", Between(1.0, 3600.0), Default("60.0");
        /// Maximum number of rows in the history: half-cycles, capacities, loss modes, remaining lives, cell models, alarms and resets. Above this number a checkpoint deletes the oldest segment (one day or about 10,000 rows). The default holds one year of ten half-cycles a day for 96 cells in about 100 MB.
        max_rows: u32, "", Between(10_000.0, 1e8), Default("1000000");
        /// Maximum age of rows in the history. A checkpoint deletes older rows one segment at a time. Ages are measured with the computer's clock. Until a hardware clock or a time server has confirmed this clock, nothing is deleted for its age.
        keep_years: Option<f64>, "years", Between(0.1, 100.0), Optional("limited by `max_rows` only");
    }
}
