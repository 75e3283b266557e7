//! Makes gaps in measured lives: keeps only a random part (window) of each record.

use std::path::Path;

/// Unit of a window's length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum WindowUnit {
    /// Time.
    Duration,
    /// Charge moved.
    Charge,
}

/// Uniform numbers in [0, 1): splitmix64.
struct Uniform(u64);

impl Uniform {
    fn draw(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// Writes the life to `to` with only a random window of 40 to 70 % of each record. The removed rows become a gap of
/// known length and unknown current.
pub(crate) fn windowed(life: &Path, to: &Path, seed: u64, by: WindowUnit) {
    let file = std::io::BufReader::new(flate2::read::GzDecoder::new(std::fs::File::open(life).unwrap()));
    let mut reader = csv::Reader::from_reader(file);
    let mut writer = csv::Writer::from_path(to).unwrap();
    writer.write_record(reader.headers().unwrap()).unwrap();
    let rows: Vec<csv::StringRecord> = reader.records().map(Result::unwrap).collect();
    let mut uniform = Uniform(seed);
    for record in rows.chunk_by(|a, b| a[0] == b[0]) {
        let along = along(record, by);
        let whole = along[along.len() - 1];
        let length = whole * (0.4 + 0.3 * uniform.draw());
        let from = (whole - length) * uniform.draw();
        for (row, at) in record.iter().zip(&along) {
            if (from..=from + length).contains(at) {
                writer.write_record(row).unwrap();
            }
        }
    }
    writer.flush().unwrap();
}

/// Time (s) or moved charge (A s) from the start of the record to each row.
fn along(record: &[csv::StringRecord], by: WindowUnit) -> Vec<f64> {
    let number = |row: &csv::StringRecord, column: usize| row[column].parse::<f64>().unwrap();
    let mut along = vec![0.0];
    for pair in record.windows(2) {
        let dt_s = number(&pair[1], 2) - number(&pair[0], 2);
        let step = match by {
            WindowUnit::Duration => dt_s,
            WindowUnit::Charge => 0.5 * (number(&pair[0], 3) + number(&pair[1], 3)).abs() * dt_s,
        };
        along.push(along[along.len() - 1] + step);
    }
    along
}
