//! Defines the grid of the tables, and finds the position of a point (SOC, temperature) in this grid.
//!
//! The rules are the same as in [`CellModel::grid_position`](crate::cell::CellModel::grid_position). All values are
//! linear along SOC. Below 0 and above 1, the OCV is extrapolated and the other values stay constant. Along
//! temperature, the OCV and the time constants are linear, and resistances follow Arrhenius' law. Outside the
//! temperature range, the nearest temperature applies.

pub use crate::cell::arrhenius;
use crate::filter::{self, locate};

/// Breakpoints of all tables.
#[derive(Debug, Clone, PartialEq)]
pub struct Grid {
    /// SOC breakpoints, strictly rising from 0 to 1, at least 2.
    pub soc: Vec<f64>,
    /// Temperature breakpoints (degrees C), strictly rising, at least 1.
    pub temperature_c: Vec<f64>,
}

/// Two SOC columns and two temperature rows around a point, with the weights of the upper column and row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GridPoint {
    /// Lower SOC column.
    pub s: usize,
    /// Lower temperature row.
    pub t: usize,
    /// Weight of the upper column for resistances and time constants, in [0, 1].
    pub along_s: f64,
    /// Weight of the upper column for the OCV; it may be outside [0, 1].
    pub beyond_s: f64,
    /// Weight of the upper row for the OCV and the time constants, in [0, 1]; 0 if there is only one temperature.
    pub along_t: f64,
    /// Weight of the upper row for resistances.
    pub warped_t: f64,
}

/// Nodes with their weights. Only the first `len` entries are valid.
#[derive(Debug, Clone, Copy, Default)]
pub struct Corners {
    /// Node numbers: temperature row times number of columns, plus column.
    pub node: [usize; 4],
    /// Weights, summing to 1.
    pub weight: [f64; 4],
    /// Number of valid nodes.
    pub len: usize,
}

impl Corners {
    /// Returns the valid nodes with their weights.
    pub fn iter(&self) -> impl Iterator<Item = (usize, f64)> + '_ {
        (0..self.len).map(|i| (self.node[i], self.weight[i]))
    }

    /// Returns the interpolated value of a table in node order.
    pub fn at(&self, values: &[f64]) -> f64 {
        self.iter().map(|(node, weight)| weight * values[node]).sum()
    }
}

impl Grid {
    /// Returns the number of nodes of a table.
    pub fn nodes(&self) -> usize {
        self.soc.len() * self.temperature_c.len()
    }

    /// Returns the position of a SOC and a temperature.
    pub fn place(&self, soc: f64, temperature_c: f64) -> GridPoint {
        let (s, beyond_s) = locate(&self.soc, soc);
        let temperatures = &self.temperature_c;
        let (t, along_t, warped_t) = if temperatures.len() == 1 {
            (0, 0.0, 0.0)
        } else {
            let (t, along) = locate(temperatures, temperature_c);
            let along = along.clamp(0.0, 1.0);
            let (low, high) = (arrhenius(temperatures[t]), arrhenius(temperatures[t + 1]));
            let inside = temperature_c.clamp(temperatures[t], temperatures[t + 1]);
            (t, along, (arrhenius(inside) - low) / (high - low))
        };
        GridPoint { s, t, along_s: beyond_s.clamp(0.0, 1.0), beyond_s, along_t, warped_t }
    }

    /// Returns the nodes and weights for the OCV.
    pub fn ocv_corners(&self, place: &GridPoint) -> Corners {
        self.corners(place, place.beyond_s, place.along_t)
    }

    /// Returns the nodes and weights for time constants.
    pub fn tau_corners(&self, place: &GridPoint) -> Corners {
        self.corners(place, place.along_s, place.along_t)
    }

    /// Returns the nodes and weights for resistances.
    pub fn resistance_corners(&self, place: &GridPoint) -> Corners {
        self.corners(place, place.along_s, place.warped_t)
    }

    fn corners(&self, place: &GridPoint, along_s: f64, along_t: f64) -> Corners {
        let columns = self.soc.len();
        let first = place.t * columns + place.s;
        let mut corners = Corners::default();
        for (node, weight) in [
            (first, (1.0 - along_s) * (1.0 - along_t)),
            (first + 1, along_s * (1.0 - along_t)),
            (first + columns, (1.0 - along_s) * along_t),
            (first + columns + 1, along_s * along_t),
        ] {
            if weight != 0.0 {
                (corners.node[corners.len], corners.weight[corners.len]) = (node, weight);
                corners.len += 1;
            }
        }
        corners
    }
}

/// Interpolates `y` linearly over rising `x`. Outside the range of `x`, the nearest value applies.
pub fn interpolate(x: &[f64], y: &[f64], at: f64) -> f64 {
    if x.len() == 1 { y[0] } else { filter::interpolate(x, y, at) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corner_weights_sum_to_one_and_follow_arrhenius() {
        let grid = Grid { soc: vec![0.0, 0.5, 1.0], temperature_c: vec![-20.0, 25.0] };
        let place = grid.place(0.7, 0.0);
        for corners in [grid.ocv_corners(&place), grid.resistance_corners(&place)] {
            assert!((corners.iter().map(|(_, w)| w).sum::<f64>() - 1.0).abs() < 1e-12);
        }
        let table: Vec<f64> = [-20.0, 25.0].iter().flat_map(|&t| [0.05 * arrhenius(t); 3]).collect();
        let found = grid.resistance_corners(&place).at(&table);
        assert!((found - 0.05 * arrhenius(0.0)).abs() < 1e-12, "{found}");
    }

    #[test]
    fn only_the_ocv_is_extrapolated_outside_the_grid() {
        let grid = Grid { soc: vec![0.0, 0.5, 1.0], temperature_c: vec![25.0] };
        let place = grid.place(1.1, 60.0);
        assert!((grid.ocv_corners(&place).at(&[3.0, 3.6, 4.2]) - 4.32).abs() < 1e-12);
        assert!((grid.resistance_corners(&place).at(&[0.1, 0.2, 0.3]) - 0.3).abs() < 1e-12);
    }
}
