//! Stores a record of any length in a limited number of bins. When all bins are used, pairs of neighbouring bins are
//! joined.

/// Maximum number of bins: about two per pixel column of a wide picture.
const MOST: usize = 2048;

pub(super) trait Bin: Clone + Default {
    fn join(&mut self, later: &Self);
}

#[derive(Debug, Clone)]
pub(super) struct Bins<B> {
    begin_s: f64,
    width_s: f64,
    bins: Vec<B>,
}

impl<B: Bin> Bins<B> {
    pub(super) fn new(begin_s: f64) -> Self {
        Self { begin_s, width_s: 1.0, bins: Vec::new() }
    }

    /// Returns the bin of a time. If a clock was set back, earlier times belong to the first bin.
    pub(super) fn at(&mut self, time_s: f64) -> &mut B {
        let after_s = (time_s - self.begin_s).max(0.0);
        while after_s / self.width_s >= MOST as f64 {
            self.join();
        }
        let index = ((after_s / self.width_s) as usize).min(MOST - 1);
        if self.bins.len() <= index {
            self.bins.resize(index + 1, B::default());
        }
        &mut self.bins[index]
    }

    fn join(&mut self) {
        self.width_s *= 2.0;
        let joined = self.bins.chunks(2).map(|pair| {
            let mut bin = pair[0].clone();
            pair[1..].iter().for_each(|later| bin.join(later));
            bin
        });
        self.bins = joined.collect();
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (f64, &B)> {
        let middle = |index: usize| self.begin_s + (index as f64 + 0.5) * self.width_s;
        self.bins.iter().enumerate().map(move |(index, bin)| (middle(index), bin))
    }

    pub(super) fn width_s(&self) -> f64 {
        self.width_s
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Clone, Default)]
    struct Count(u64);

    impl Bin for Count {
        fn join(&mut self, later: &Self) {
            self.0 += later.0;
        }
    }

    #[test]
    fn long_record_stays_small_and_complete() {
        let mut bins = Bins::<Count>::new(1.7e9);
        (0..1_000_000).for_each(|second| bins.at(1.7e9 + f64::from(second)).0 += 1);
        bins.at(0.0).0 += 1;
        assert!(bins.iter().count() <= MOST && bins.width_s() == 512.0);
        assert_eq!(bins.iter().map(|(_, count)| count.0).sum::<u64>(), 1_000_001);
    }

    #[test]
    fn jump_of_centuries_takes_no_memory() {
        let mut bins = Bins::<Count>::new(0.0);
        bins.at(0.0).0 += 1;
        bins.at(9e9).0 += 1;
        assert_eq!(bins.iter().map(|(_, count)| count.0).sum::<u64>(), 2);
    }
}
