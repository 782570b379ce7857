//! Alternates quiet and attacked blocks of time, and compares them.

use gleaner_bench::{Figure, quantile};

/// Length of a block.
pub(super) const BLOCK_MS: i64 = 2500;
/// Begin of a block that is not measured: an attack of the previous block may end in it.
const SETTLE_NS: i64 = 400_000_000;
const BLOCK_NS: i64 = BLOCK_MS * 1_000_000;

/// The blocks of one attack. By wall-clock time, blocks with an even number are quiet and those
/// with an odd one attacked.
pub(super) struct BlockSchedule {
    first_ns: i64,
    pairs: usize,
}

impl BlockSchedule {
    /// Begins with the first quiet block after `now_ns`.
    pub(super) fn after(now_ns: i64, pairs: usize) -> Self {
        Self { first_ns: (now_ns / (2 * BLOCK_NS) + 1) * 2 * BLOCK_NS, pairs }
    }

    pub(super) fn end_ns(&self) -> i64 {
        self.first_ns + 2 * self.pairs as i64 * BLOCK_NS
    }

    /// Index of the block whose measured part contains this interval.
    pub(super) fn block(&self, from_ns: i64, to_ns: i64) -> Option<usize> {
        let block = (from_ns - self.first_ns).div_euclid(BLOCK_NS);
        let begin_ns = self.first_ns + block * BLOCK_NS;
        let is_in = from_ns >= begin_ns + SETTLE_NS && to_ns < begin_ns + BLOCK_NS;
        usize::try_from(block).ok().filter(|block| is_in && *block < 2 * self.pairs)
    }

    pub(super) fn grouped(
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

    /// Measured seconds of the quiet blocks, and as many of the attacked ones, together.
    pub(super) fn measured_s(&self) -> f64 {
        2.0 * self.pairs as f64 * (BLOCK_NS - SETTLE_NS) as f64 / 1e9
    }
}

/// Compares attacked with quiet blocks, and quiet with quiet ones. `blocks` has one value for each
/// block, in us.
///
/// The goal is the median difference of two quiet blocks: a median difference that is no larger
/// cannot be distinguished from noise. Without `has_goal` the row is for information only.
pub(super) fn compare(what: &str, has_goal: bool, blocks: &[f64], figures: &mut Vec<Figure>) {
    let quiet = blocks.iter().step_by(2).copied().collect::<Vec<_>>();
    let attacked = blocks.iter().skip(1).step_by(2);
    let differences =
        attacked.zip(&quiet).map(|(attacked, quiet)| attacked - quiet).collect::<Vec<_>>();
    let baseline = quiet.chunks_exact(2).map(|pair| pair[1] - pair[0]).collect::<Vec<_>>();
    let spread = quantile(&baseline.iter().map(|us| us.abs()).collect::<Vec<_>>(), 0.5);
    // As printed.
    let spread = (100.0 * spread).round() / 100.0;
    figures.push(Figure::without_goal(&format!("{what}, quiet"), "us", &quiet));
    figures.push(Figure::without_goal(
        &format!("{what}, quiet minus quiet (A/A)"),
        "us",
        &baseline,
    ));
    let name = format!("{what}, attacked minus quiet");
    figures.push(match has_goal {
        true => Figure::at_most(&name, "us", spread, &differences),
        false => Figure::without_goal(&name, "us", &differences),
    });
}
