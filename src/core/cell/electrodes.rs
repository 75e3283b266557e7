//! Computes a cell's open-circuit voltage from the potentials of its two electrodes, for the new and the aged cell.
//!
//! V(z) = U_p(y) - U_n(x), where z is the SOC, and x and y are the lithium contents (stoichiometry, 0 to 1) of the
//! negative and the positive electrode. Both contents are linear in the charge. Q_n and Q_p are the capacities of the
//! electrodes, and n is the cyclable lithium, all relative to the new cell's capacity: Q_p y + Q_n x = n. An aged cell
//! is full and empty at the same voltages as the new cell. Its capacity is Q_n (x_full - x_empty).
//!
//! An ageing cell loses lithium (n falls) and active material of the electrodes (Q_n and Q_p fall): Birkl et al., J.
//! Power Sources 341 (2017) 373; Dubarry et al., J. Power Sources 219 (2012) 204. The lithium content of the lost
//! material need not be known, because it only changes n, and n follows from the capacity.
//!
//! In: materials and lithium contents of the new cell. Out: V, and capacity as a fraction of the new cell's capacity.
//! Contents are limited to 0 to 1. If a cell with the given losses and capacity cannot exist, there is no curve. An
//! ageing cell never gains lithium.

use crate::filter::crossing;

/// Smallest distance of a lithium content from 0 and 1, where the half-cell functions diverge.
const EDGE: f64 = 1e-4;

/// Half-cell potential of a positive electrode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PositiveMaterial {
    /// LiNi0.8Mn0.1Co0.1O2: Chen et al., J. Electrochem. Soc. 167 (2020) 080534.
    Nmc811,
    /// LiNi0.5Mn0.3Co0.2O2: Mohtat et al., J. Electrochem. Soc. 167 (2020) 110561.
    Nmc532,
    /// LiNiCoAlO2: Kim et al., J. Electrochem. Soc. 158 (2011) A955.
    Nca,
    /// LiNiCoO2: Ecker et al., J. Electrochem. Soc. 162 (2015) A1836.
    Nco,
    /// LiCoO2: Doyle, thesis, Berkeley 1995, as in Newman's Dualfoil.
    Lco,
    /// LiCoO2: Ramadass et al., J. Electrochem. Soc. 151 (2004) A196.
    LcoRamadass,
    /// LiMn2O4: Doyle et al., J. Electrochem. Soc. 143 (1996) 1890.
    Lmo,
    /// LiFePO4: Afshar et al., arXiv 1709.03970 (2017).
    Lfp,
}

/// Half-cell potential of a negative electrode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NegativeMaterial {
    /// Graphite with silicon oxide: Chen et al., J. Electrochem. Soc. 167 (2020) 080534.
    GraphiteSiox,
    /// Graphite: Ecker et al., J. Electrochem. Soc. 162 (2015) A1836.
    Graphite,
    /// Graphite with sharp stages: Mohtat et al., J. Electrochem. Soc. 167 (2020) 110561.
    GraphiteStaged,
    /// Graphite of a cell with NCA: Kim et al., J. Electrochem. Soc. 158 (2011) A955.
    GraphiteKim,
    /// Mesocarbon microbeads: Newman's Dualfoil.
    Mcmb,
    /// Mesocarbon microbeads: Ramadass et al., J. Electrochem. Soc. 151 (2004) A196.
    McmbRamadass,
}

impl PositiveMaterial {
    /// Every material, with its name in a cell model file.
    pub const ALL: [(Self, &'static str); 8] = [
        (Self::Nmc811, "nmc811"),
        (Self::Nmc532, "nmc532"),
        (Self::Nca, "nca"),
        (Self::Nco, "nco"),
        (Self::Lco, "lco"),
        (Self::LcoRamadass, "lco_ramadass"),
        (Self::Lmo, "lmo"),
        (Self::Lfp, "lfp"),
    ];

    /// Minimum valid lithium content. Below it, the published functions rise or have poles.
    pub const fn least_content(self) -> f64 {
        match self {
            Self::Nca => 0.3,
            Self::Lco => 0.4,
            Self::LcoRamadass => 0.44,
            Self::Nmc811 | Self::Nmc532 | Self::Nco | Self::Lmo | Self::Lfp => EDGE,
        }
    }

    /// Potential against lithium (V) at a lithium content, which is limited to the valid contents.
    pub fn potential_v(self, y: f64) -> f64 {
        use libm::{exp, pow, tanh};
        let y = y.clamp(self.least_content(), 1.0 - EDGE);
        match self {
            Self::Nmc811 => {
                -0.8090 * y + 4.4875 - 0.0428 * tanh(18.5138 * (y - 0.5542)) - 17.7326 * tanh(15.7890 * (y - 0.3117))
                    + 17.5842 * tanh(15.9308 * (y - 0.3120))
            }
            Self::Nmc532 => {
                polynomial(&[4.3452, -1.6518, 1.6225, -2.0843, 3.5146, -2.2166], y)
                    - 0.5623e-4 * exp(109.451 * y - 100.006)
            }
            Self::Nca => {
                let shape =
                    [11.8058, -66.3691, 264.427, -554.774, 621.3475, -344.566, 81.246, -23.488, 15.056, -2.222, 1.638];
                polynomial(&shape, y) - 0.61386 * exp(5.8201 * pow(y, 136.4))
            }
            Self::Nco => {
                -2.35211 * y - 0.0747061 * tanh(31.886 * (y - 0.0219921)) + 6.34984 * tanh(2.66395 * (y - 0.174352))
                    - 0.640243 * tanh(5.48623 * (y - 0.439245))
                    - 3.82383 * tanh(4.12167 * (y - 0.176187))
                    - 0.0542123 * tanh(18.2919 * (y - 0.762272))
                    + 4.23285
            }
            Self::Lco => {
                let y = 1.062 * y;
                2.16216 + 0.07645 * tanh(30.834 - 54.4806 * y) + 2.1581 * tanh(52.294 - 50.294 * y)
                    - 0.14169 * tanh(11.0923 - 19.8543 * y)
                    + 0.2051 * tanh(1.4684 - 5.4888 * y)
                    + 0.2531 * tanh((0.56478 - y) / 0.1316)
                    - 0.02167 * tanh((y - 0.525) / 0.006)
            }
            Self::LcoRamadass => {
                let above = [-4.656, 88.669, -401.119, 342.909, -462.471, 433.434];
                let below = [-1.0, 18.933, -79.532, 37.311, -73.083, 95.96];
                polynomial(&above, y * y) / polynomial(&below, y * y)
            }
            Self::Lmo => {
                let near_full = (0.998_432 - y).max(EDGE);
                4.19829 + 0.0565661 * tanh(8.60942 - 14.5546 * y)
                    - 0.0275479 * (pow(near_full, -0.492465) - 1.90111)
                    - 0.157123 * exp(-0.04738 * pow(y, 8.0))
                    + 0.810239 * exp(-40.0 * (y - 0.133875))
            }
            Self::Lfp => 3.4077 - 0.020269 * y + 0.5 * exp(-150.0 * y) - 0.9 * exp(-30.0 * (1.0 - y)),
        }
    }
}

impl NegativeMaterial {
    /// Every material, with its name in a cell model file.
    pub const ALL: [(Self, &'static str); 6] = [
        (Self::GraphiteSiox, "graphite_siox"),
        (Self::Graphite, "graphite"),
        (Self::GraphiteStaged, "graphite_staged"),
        (Self::GraphiteKim, "graphite_kim"),
        (Self::Mcmb, "mcmb"),
        (Self::McmbRamadass, "mcmb_ramadass"),
    ];

    /// Potential against lithium (V) at a lithium content, which is limited to the range from [`EDGE`] to 1 - [`EDGE`].
    pub fn potential_v(self, x: f64) -> f64 {
        use libm::{exp, tanh};
        let x = x.clamp(EDGE, 1.0 - EDGE);
        match self {
            Self::GraphiteSiox => {
                1.9793 * exp(-39.3631 * x) + 0.2482
                    - 0.0909 * tanh(29.8538 * (x - 0.1234))
                    - 0.04478 * tanh(14.9159 * (x - 0.2769))
                    - 0.0205 * tanh(30.4444 * (x - 0.6103))
            }
            Self::Graphite => {
                0.716502 * exp(-369.028 * x) + 0.12193 * exp(-35.6478 * (x - 0.0530947))
                    - 0.0189193 * tanh(21.1967 * (x - 0.196176))
                    - 0.0169644 * tanh(27.1365 * (x - 0.312832))
                    - 0.0199313 * tanh(28.5697 * (x - 0.614221))
                    - 0.931153 * exp(36.328 * (x - 1.10743))
                    + 0.140031
            }
            Self::GraphiteStaged => {
                0.063 + 0.8 * exp(-75.0 * (x + 0.001))
                    - 0.0120 * tanh((x - 0.127) / 0.016)
                    - 0.0118 * tanh((x - 0.155) / 0.016)
                    - 0.0035 * tanh((x - 0.220) / 0.020)
                    - 0.0095 * tanh((x - 0.190) / 0.013)
                    - 0.0145 * tanh((x - 0.490) / 0.020)
                    - 0.0800 * tanh((x - 1.030) / 0.055)
            }
            Self::GraphiteKim => {
                0.124 + 1.5 * exp(-70.0 * x)
                    - 0.0351 * tanh((x - 0.286) / 0.083)
                    - 0.0045 * tanh((x - 0.9) / 0.119)
                    - 0.035 * tanh((x - 0.99) / 0.05)
                    - 0.0147 * tanh((x - 0.5) / 0.034)
                    - 0.102 * tanh((x - 0.194) / 0.142)
                    - 0.022 * tanh((x - 0.98) / 0.0164)
                    - 0.011 * tanh((x - 0.124) / 0.0226)
                    + 0.0155 * tanh((x - 0.105) / 0.029)
            }
            Self::McmbRamadass => {
                0.7222 + 0.1387 * x + 0.029 * libm::sqrt(x) - 0.0172 / x
                    + 0.0019 / (x * libm::sqrt(x))
                    + 0.2808 * exp(0.90 - 15.0 * x)
                    - 0.7984 * exp(0.4465 * x - 0.4108)
            }
            Self::Mcmb => {
                0.194 + 1.5 * exp(-120.0 * x) + 0.0351 * tanh((x - 0.286) / 0.083)
                    - 0.0045 * tanh((x - 0.849) / 0.119)
                    - 0.035 * tanh((x - 0.9233) / 0.05)
                    - 0.0147 * tanh((x - 0.5) / 0.034)
                    - 0.102 * tanh((x - 0.194) / 0.142)
                    - 0.022 * tanh((x - 0.9) / 0.0164)
                    - 0.011 * tanh((x - 0.124) / 0.0226)
                    + 0.0155 * tanh((x - 0.105) / 0.029)
            }
        }
    }
}

fn polynomial(coefficients: &[f64], x: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, c| sum * x + c)
}

/// The electrodes of a new cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Electrodes {
    /// Positive material.
    pub positive: PositiveMaterial,
    /// Negative material.
    pub negative: NegativeMaterial,
    /// Lithium content of the positive electrode in the empty and in the full cell, falling.
    pub positive_content: [f64; 2],
    /// Lithium content of the negative electrode in the empty and in the full cell, rising.
    pub negative_content: [f64; 2],
}

/// Active material lost, as a fraction of the new electrode's material.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LostMaterial {
    /// Loss of the negative electrode.
    pub negative: f64,
    /// Loss of the positive electrode.
    pub positive: f64,
}

/// An aged cell of these electrodes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AgedElectrodes {
    electrodes: Electrodes,
    negative_capacity: f64,
    positive_capacity: f64,
    lithium: f64,
    negative_content: [f64; 2],
}

impl Electrodes {
    /// Names of the positive and the negative material in a cell model file.
    pub fn names(&self) -> (&'static str, &'static str) {
        let positive = PositiveMaterial::ALL.iter().find(|(material, _)| *material == self.positive);
        let negative = NegativeMaterial::ALL.iter().find(|(material, _)| *material == self.negative);
        (positive.map_or("", |found| found.1), negative.map_or("", |found| found.1))
    }

    /// Open-circuit voltage of the new cell (V).
    pub fn voltage_v(&self, soc: f64) -> f64 {
        let between = |[empty, full]: [f64; 2]| empty + soc * (full - empty);
        self.positive.potential_v(between(self.positive_content))
            - self.negative.potential_v(between(self.negative_content))
    }

    /// Capacities of the new negative and positive electrodes, and cyclable lithium, all relative to the cell's
    /// capacity.
    fn new_contents(&self) -> [f64; 3] {
        let negative = 1.0 / (self.negative_content[1] - self.negative_content[0]);
        let positive = 1.0 / (self.positive_content[0] - self.positive_content[1]);
        [negative, positive, negative * self.negative_content[1] + positive * self.positive_content[1]]
    }

    /// The cell after it has lost the material `lost`, and so much lithium that the fraction `capacity` of the new
    /// capacity remains. Returns `None` if such a cell does not exist or cannot reach its end voltages. Also returns
    /// `None` if the new cell contains more lithium than it can use, because the capacity then does not determine the
    /// loss.
    pub fn aged(&self, lost: LostMaterial, capacity: f64) -> Option<AgedElectrodes> {
        let [negative, positive, new_lithium] = self.new_contents();
        let ends_v = [0.0, 1.0].map(|soc| self.voltage_v(soc));
        let cell = |lost: LostMaterial, lithium: f64| {
            let mut cell = AgedElectrodes {
                electrodes: *self,
                negative_capacity: negative * (1.0 - lost.negative),
                positive_capacity: positive * (1.0 - lost.positive),
                lithium,
                negative_content: [0.0; 2],
            };
            cell.negative_content = ends_v.map(|voltage_v| cell.content_at(voltage_v));
            cell
        };
        let new = |lithium: f64| cell(LostMaterial::default(), lithium).capacity();
        // A new cell without excess lithium loses capacity if it loses a little lithium.
        if new(0.995 * new_lithium) >= new(new_lithium) {
            return None;
        }
        let is_below = |lithium: f64| cell(lost, lithium).capacity() < capacity;
        let found = cell(lost, crossing((0.05 * new_lithium, new_lithium), is_below));
        let reaches = |(soc, end_v): (f64, f64)| (found.voltage_v(soc) - end_v).abs() < 0.001;
        let is_whole = [0.0, 1.0].into_iter().zip(ends_v).all(reaches);
        (is_whole && (found.capacity() - capacity).abs() < 1e-6).then_some(found)
    }
}

impl AgedElectrodes {
    /// Voltage (V) at a lithium content of the negative electrode. The voltage rises with the content.
    fn voltage_at(&self, x: f64) -> f64 {
        let y = (self.lithium - self.negative_capacity * x) / self.positive_capacity;
        self.electrodes.positive.potential_v(y) - self.electrodes.negative.potential_v(x)
    }

    fn content_at(&self, voltage_v: f64) -> f64 {
        let low = ((self.lithium - self.positive_capacity) / self.negative_capacity).max(EDGE);
        let high = (self.lithium / self.negative_capacity).min(1.0 - EDGE);
        crossing((low, high), |x| self.voltage_at(x) < voltage_v)
    }

    /// Capacity relative to the new cell.
    pub fn capacity(&self) -> f64 {
        self.negative_capacity * (self.negative_content[1] - self.negative_content[0])
    }

    /// Open-circuit voltage (V).
    pub fn voltage_v(&self, soc: f64) -> f64 {
        let [empty, full] = self.negative_content;
        self.voltage_at(empty + soc * (full - empty))
    }

    /// Cyclable lithium lost, as a fraction of the new cell's lithium.
    pub fn lithium_lost(&self) -> f64 {
        1.0 - self.lithium / self.electrodes.new_contents()[2]
    }
}

#[cfg(test)]
pub(crate) mod tests;
