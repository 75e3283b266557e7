//! The tables of the vehicle, its pack and interfaces, the alarms and the store.

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
    /// Which vehicle and pack this is, for status, metrics, events, reports and history. Each key is at most 64 characters long. A change needs a restart.
    Vehicle at "vehicle" {
        /// Name of the vehicle. Without it: not stated.
        name: Option<String>, "", NotEmpty, Optional;
        /// Vehicle identification number or fleet number. Without it: not stated.
        id: Option<String>, "", NotEmpty, Optional;
        /// Name of the pack, in a vehicle with several packs. Without it: not stated.
        pack: Option<String>, "", NotEmpty, Optional;
    }
}

section! {
    /// The pack: how many cells, how they are connected, and which cell they are.
    Pack at "pack" {
        /// Cells in series. Parallel cells that share one voltage tap count as one.
        cells: u16, "", Between(1.0, MAX_CELLS as f64), Required;
        /// Parallel strings; each is assumed to carry an equal share of the pack current.
        strings: u16, "", Between(1.0, 1024.0), Default("1");
        /// Cell model file, relative to this file. Without it: `chemistry` and `rated_capacity_ah` give a model.
        cell_model: Option<String>, "", NotEmpty, Optional;
        /// Chemistry of a cell without a model file: estimates begin with what all such cells have in common, and their intervals are as wide as these cells differ. LMO is that of early electric cars, blended with a layered oxide; "nmc-graphite" when the nickel content is not known. Without it: `cell_model` is needed.
        chemistry: Option<Chemistry>, "", Any, Optional;
        /// Whether the model of a cell without a model file is learned on board from drives, charges and rests.
        learn_model: bool, "", Any, Default("true");
        /// Whether the BMS balances: lets the fuller cells lose charge towards and after the end of a charge. Then only the cell with the least charge is one that may leak, unless `[input.balancing]` shows which cells are bled.
        balancing: bool, "", Any, Default("true");
        /// Lowest voltage of a cell without a model file: empty. Without it: usual of the chemistry (NMC, NCA and LFP 2.5 V, else 3.0 V).
        voltage_min_v: Option<f64>, "V", Above(0.0, 100.0), Optional;
        /// Highest voltage of a cell without a model file: full. Without it: usual of the chemistry (LFP 3.65 V, else 4.2 V).
        voltage_max_v: Option<f64>, "V", Above(0.0, 100.0), Optional;
        /// Capacity on the label of one cell, which SOH is relative to. Without it: the cell model's.
        rated_capacity_ah: Option<f64>, "Ah", within(bounds::CONFIGURED_CAPACITY_AH), Optional;
        /// Capacity of a cell to start from, before any is learned. Without it: the cell model's `capacity_ah`.
        initial_capacity_ah: Option<f64>, "Ah", within(bounds::CONFIGURED_CAPACITY_AH), Optional;
        /// Standard deviation of the capacity to start from. Without it: 10 % of that capacity.
        initial_capacity_std_ah: Option<f64>, "Ah", Above(0.0, 1e5), Optional;
        /// Temperature of the surroundings, for cells without a sensor.
        ambient_c: f64, "degrees C", TEMPERATURE_C, Default("25.0");
    }
}

section! {
    /// Cells of another kind than the pack's own: a replaced module, or one of another maker. They have a model of their own, which is not learned on board, and are not compared with the pack's own cells.
    PackModule at "pack.module" {
        /// Cells of the module.
        cells: CellRanges, "", Any, Required;
        /// Cell model file, relative to this file. Without it: `chemistry` and `rated_capacity_ah` give a model.
        cell_model: Option<String>, "", NotEmpty, Optional;
        /// Chemistry of a cell without a model file, as for `[pack]`. Without it: `cell_model` is needed.
        chemistry: Option<Chemistry>, "", Any, Optional;
        /// Capacity on the label of one cell, which SOH is relative to. Without it: the cell model's.
        rated_capacity_ah: Option<f64>, "Ah", within(bounds::CONFIGURED_CAPACITY_AH), Optional;
        /// Capacity of a cell to start from, before any is learned. Without it: the cell model's `capacity_ah`.
        initial_capacity_ah: Option<f64>, "Ah", within(bounds::CONFIGURED_CAPACITY_AH), Optional;
        /// Standard deviation of the capacity to start from. Without it: 10 % of that capacity.
        initial_capacity_std_ah: Option<f64>, "Ah", Above(0.0, 1e5), Optional;
    }
}

section! {
    /// A CAN interface. The program numbers the interfaces in the order of the file.
    Interface at "interface" {
        /// Kernel name, at most 15 characters.
        name: String, "", NotEmpty, Required;
        /// Whether CAN FD frames are accepted and may be sent.
        fd: bool, "", Any, Default("false");
    }
}

section! {
    /// The alarms of a rule. What each rule compares, and the unit of its thresholds:
    /// `capacity_low`, `usable_capacity_low` Ah per cell; `recharge_period_low` s; `resistance_high` times that of a new cell;
    /// `soc_low` (of the emptiest cell), `cell_imbalance` (SOC of the fullest less that of the emptiest cell), `bms_disagrees` (SOC or SOH as the pack reports it less the estimate), `input_implausible` (share of bad readings) fractions;
    /// `temperature_high` (the hottest sensor) degrees C; `remaining_life_low` equivalent full cycles;
    /// `input_missing`, `store_failed` and `bus_fault` (how long it has lasted) s; `estimate_untrusted` the mean normalised innovation squared, or the mismatch of the cell model in that scale;
    /// each cell against the others: `cell_leak` (its self-discharge in a day, of its capacity), `connection_resistance` (its contact resistance beyond theirs, of a cell's series resistance at half charge and 25 degrees C) fractions; `channel_faulty` 1 while its voltage channel is faulty (frozen, off, doubled or exchanged), else 0.
    Alarm at "alarm" {
        /// What the alarm compares.
        rule: Rule, "", Any, Required;
        /// Threshold of the alarm of severity "info": the alarm is raised when the value is below it (`*_low`) or above it (the others). A number in the rule's unit, or a text like "80 %": percent of the rated capacity, of the period in which the reference charger charges it, of the resistance of a new cell, or of the fraction 1. With `{ set = ..., clear = ... }` the alarm clears at `clear`. At least one of `info`, `warning` and `severe` is needed, and each at most once per rule.
        info: Option<Threshold>, "the rule's", Between(-1e9, 1e9), Optional;
        /// The same for severity "warning". Without it: no such alarm.
        warning: Option<Threshold>, "the rule's", Between(-1e9, 1e9), Optional;
        /// The same for severity "severe". Without it: no such alarm.
        severe: Option<Threshold>, "the rule's", Between(-1e9, 1e9), Optional;
        /// The alarm clears when the value is back on the healthy side of the threshold by this much, where the threshold has no `clear`. Without it: 2 % of the threshold. An alarm of a learned value also waits until the truth is there with a probability of 95 %.
        hysteresis: Option<f64>, "the rule's", Between(0.0, 1e9), Optional;
        /// What is compared with the threshold. "mean": the value itself. `{ probability = 0.95 }`: the alarm is raised when the probability that the true value is beyond the threshold exceeds that level, and clears when the probability that it is beyond the clear threshold is at most that level and at most one half. A level above one half raises the alarm later and less often wrongly; a level below it raises it earlier.
        when: Comparison, "", Any, Default("\"mean\"");
        /// The value must be beyond the threshold this long before the alarm is raised, and healthy this long before it clears.
        debounce_s: f64, "s", Between(0.0, 1e9), Default("0.0");
        /// As many new values must agree before the alarm is raised or cleared.
        debounce_events: u32, "", Between(1.0, 1e6), Default("1");
        /// Whether the alarm stays raised when the value is healthy again, until a command clears it.
        latched: bool, "", Any, Default("false");
        /// J1939: suspect parameter number. Without it: 520192 (maker-assignable) plus the rule's number.
        spn: Option<u32>, "", Between(1.0, 524_287.0), Optional;
        /// J1939: failure mode identifier. Without it: by rule and severity (17, 18, 1 for a value too low, 15, 16, 0 for one too high; 9 for a missing input, 2 for an implausible one, a pack that disagrees and a faulty channel, 19 for a bus, 31 for an estimate not to be trusted and a store).
        fmi: Option<u8>, "", Between(0.0, 31.0), Optional;
    }
}

section! {
    /// State and history on disk (`run --state`). Learned values are stored when they are announced, whatever is set here.
    Store at "store" {
        /// Least period of the checkpoints of the running state: a power cut loses at most this much of it (a restart of the service loses a second). Each writes the whole state, some 70 kB for a pack of 96 cells; the period is longer where more than 15 MB a day would be written, 7 minutes for such a pack.
        checkpoint_s: f64, "s", Between(1.0, 3600.0), Default("60.0");
        /// Rows of the history kept: half-cycles, capacities, loss modes, remaining lives, cell models, alarms and resets. Beyond this number the oldest segment, a day or some 10000 rows, is deleted at a checkpoint. The default holds a year of ten half-cycles a day of 96 cells, in some 100 MB.
        max_rows: u32, "", Between(10_000.0, 1e8), Default("1000000");
        /// Rows of the history older than this are deleted, a segment at a checkpoint. The age is that on the computer's clock, and nothing is deleted while no hardware clock or time server confirms that clock. Without it: only `max_rows` bounds them.
        keep_years: Option<f64>, "years", Between(0.1, 100.0), Optional;
    }
}
