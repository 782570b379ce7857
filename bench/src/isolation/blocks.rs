//! Quiet and attacked blocks of time, in turn, and what is compared between them.

use crate::measure::{Figure, quantile};

/// Length of a block.
pub(super) const BLOCK_MS: i64 = 2500;
/// Its begin, which is left out: what an attack began in the block before may end in this one.
const SETTLE_NS: i64 = 400_000_000;
const BLOCK_NS: i64 = BLOCK_MS * 1_000_000;

/// The blocks of one attack: by the time of day, those with an even number are quiet, those with an
/// odd one attacked.
pub(super) struct Course {
    first_ns: i64,
    pairs: usize,
}

impl Course {
    /// Begins with the first quiet block that begins after `now_ns`.
    pub(super) fn after(now_ns: i64, pairs: usize) -> Self {
        Self { first_ns: (now_ns / (2 * BLOCK_NS) + 1) * 2 * BLOCK_NS, pairs }
    }

    pub(super) fn end_ns(&self) -> i64 {
        self.first_ns + 2 * self.pairs as i64 * BLOCK_NS
    }

    /// The block, from 0, in whose measured part all of this time lies.
    pub(super) fn block(&self, from_ns: i64, to_ns: i64) -> Option<usize> {
        let block = (from_ns - self.first_ns).div_euclid(BLOCK_NS);
        let begin_ns = self.first_ns + block * BLOCK_NS;
        let is_in = from_ns >= begin_ns + SETTLE_NS && to_ns < begin_ns + BLOCK_NS;
        usize::try_from(block).ok().filter(|block| is_in && *block < 2 * self.pairs)
    }

    /// The values of each block.
    pub(super) fn sorted_in(
        &self,
        values: impl Iterator<Item = (Option<usize>, f64)>,
    ) -> Vec<Vec<f64>> {
        let mut blocks = vec![Vec::new(); 2 * self.pairs];
        for (block, value) in values {
            if let Some(block) = block {
                blocks[block].push(value);
            }
        }
        blocks
    }

    /// Seconds in which is measured, quiet and attacked.
    pub(super) fn measured_s(&self) -> f64 {
        2.0 * self.pairs as f64 * (BLOCK_NS - SETTLE_NS) as f64 / 1e9
    }
}

/// `what`, of which there is one value in us for each block: attacked against quiet, beside quiet
/// against quiet.
///
/// The goal is how much two quiet blocks differ, as a median: a median over all pairs that is no
/// larger cannot be told from nothing. It is not `promised` where it is not ours to keep.
pub(super) fn compare(what: &str, promised: bool, blocks: &[f64], figures: &mut Vec<Figure>) {
    let quiet = blocks.iter().step_by(2).copied().collect::<Vec<_>>();
    let attacked = blocks.iter().skip(1).step_by(2);
    let differences =
        attacked.zip(&quiet).map(|(attacked, quiet)| attacked - quiet).collect::<Vec<_>>();
    let by_itself = quiet.chunks_exact(2).map(|pair| pair[1] - pair[0]).collect::<Vec<_>>();
    let spread = quantile(&by_itself.iter().map(|us| us.abs()).collect::<Vec<_>>(), 0.5);
    // As it is shown.
    let spread = (100.0 * spread).round() / 100.0;
    figures.push(Figure::told(&format!("{what}, quiet"), "us", &quiet));
    figures.push(Figure::told(&format!("{what}, quiet less quiet (A/A)"), "us", &by_itself));
    let name = format!("{what}, attacked less quiet");
    figures.push(match promised {
        true => Figure::at_most(&name, "us", spread, &differences),
        false => Figure::told(&name, "us", &differences),
    });
}
