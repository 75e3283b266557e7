//! Reduces long series to the resolution of a picture.

/// Divides a line into `bins` bins along x, and keeps the first, lowest, highest and last point of each bin, in order.
/// A short line is returned unchanged.
pub(super) fn line(points: &[(f64, f64)], bins: usize) -> Vec<(f64, f64)> {
    let mut kept = Vec::with_capacity(points.len().min(4 * bins));
    if points.len() <= 4 * bins {
        return points.to_vec();
    }
    let bin_of = binning(points.iter().map(|point| point.0), bins);
    for bin in points.chunk_by(|a, b| bin_of(a.0) == bin_of(b.0)) {
        let by_y = |a: &usize, b: &usize| bin[*a].1.total_cmp(&bin[*b].1);
        let lowest = (0..bin.len()).min_by(by_y).unwrap_or(0);
        let highest = (0..bin.len()).max_by(by_y).unwrap_or(0);
        let mut chosen = [0, lowest, highest, bin.len() - 1];
        chosen.sort_unstable();
        kept.extend(chosen.into_iter().map(|index| bin[index]));
    }
    kept.dedup();
    kept
}

/// Returns the lowest lower end and the highest upper end of each bin, at the first and last x of the bin. A short band
/// is returned unchanged.
pub(super) fn band(points: &[(f64, f64, f64)], bins: usize) -> Vec<(f64, f64, f64)> {
    if points.len() <= 2 * bins {
        return points.to_vec();
    }
    let bin_of = binning(points.iter().map(|point| point.0), bins);
    let mut kept = Vec::with_capacity(2 * bins);
    for bin in points.chunk_by(|a, b| bin_of(a.0) == bin_of(b.0)) {
        let low = bin.iter().map(|p| p.1).fold(f64::INFINITY, f64::min);
        let high = bin.iter().map(|p| p.2).fold(f64::NEG_INFINITY, f64::max);
        kept.extend([(bin[0].0, low, high), (bin[bin.len() - 1].0, low, high)]);
    }
    kept.dedup();
    kept
}

/// Returns the function that maps x to its bin. The x values of the series must not decrease.
fn binning(mut xs: impl DoubleEndedIterator<Item = f64>, bins: usize) -> impl Fn(f64) -> f64 {
    let first = xs.next().unwrap_or(0.0);
    let last = xs.next_back().unwrap_or(first);
    let width = ((last - first) / bins.max(1) as f64).max(f64::MIN_POSITIVE);
    // The last point belongs to the last bin.
    move |x| ((x - first) / width).floor().min(bins.max(1) as f64 - 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn single_peak_is_kept() {
        let mut points: Vec<(f64, f64)> = (0..200_000).map(|i| (f64::from(i), 0.0)).collect();
        points[77_777].1 = 5.0;
        points[123_456].1 = -3.0;
        let kept = line(&points, 1000);
        assert!(kept.len() <= 4004, "{} points", kept.len());
        assert!(kept.contains(&(77_777.0, 5.0)) && kept.contains(&(123_456.0, -3.0)));
        assert!(kept.is_sorted_by(|a, b| a.0 <= b.0), "out of order");
        assert_eq!((kept.first(), kept.last()), (points.first(), points.last()));
    }

    #[test]
    fn band_never_becomes_narrower() {
        let points: Vec<_> = (0..10_000).map(|i| (f64::from(i), -f64::from(i % 7), f64::from(i % 11))).collect();
        let kept = band(&points, 100);
        assert!(kept.len() <= 202);
        assert!(kept.iter().all(|p| p.1 == -6.0 && p.2 == 10.0));
    }
}
