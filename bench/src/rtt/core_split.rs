//! Cores of the sides, apart from those of the sender and the recorder.

use gleaner_bench::CoreList;

use crate::measure::{bind_to, cores};

pub(super) struct CoreSplit {
    all: CoreList,
    sides: CoreList,
    others: CoreList,
}

/// Parses the cores of the sides.
///
/// # Errors
///
/// The reason why the sides cannot run on them.
pub(super) fn cores_of_sides(text: &str) -> Result<CoreList, String> {
    let sides: CoreList = text.parse()?;
    sides.others_of(&usable()?)?;
    Ok(sides)
}

fn usable() -> Result<CoreList, String> {
    let cores = cores().map_err(|error| format!("cannot determine the usable cores: {error}"))?;
    Ok(cores.into_iter().collect())
}

impl CoreSplit {
    /// Leaves the sides these cores, all by default, and binds this thread, which starts the sender
    /// and the recorder, to the others, if there are others.
    ///
    /// # Errors
    ///
    /// The reason why the cores cannot be used.
    pub(super) fn of(sides: Option<&CoreList>) -> Result<Self, String> {
        let all = usable()?;
        let sides = sides.unwrap_or(&all).clone();
        let others = sides.others_of(&all)?.unwrap_or_else(|| all.clone());
        if others != all {
            bind(&others)?;
        }
        Ok(Self { all, sides, others })
    }

    /// Describes the cores, for the notes of the results.
    pub(super) fn note(&self) -> String {
        let Self { all, sides, others } = self;
        let shared = if all == others { ", as there are no others" } else { "" };
        format!(
            "Cores (`--cpus`): {sides} for all processes of the sides, {others} for the sender and \
             the recorder{shared}."
        )
    }

    /// Starts something on the cores of the sides: its threads and processes inherit them. So do
    /// the threads of this program that wait for its lines.
    pub(super) fn for_side<T>(&self, start: impl FnOnce() -> T) -> T {
        self.on(&self.sides, start)
    }

    /// Starts something on all cores.
    pub(super) fn for_all<T>(&self, start: impl FnOnce() -> T) -> T {
        self.on(&self.all, start)
    }

    fn on<T>(&self, cores: &CoreList, start: impl FnOnce() -> T) -> T {
        if *cores == self.others {
            return start();
        }
        bind(cores).expect("the cores were usable before");
        let _bound = BoundAgain(&self.others);
        start()
    }
}

/// Binds this thread to its usual cores on drop, also after a side that could not start.
struct BoundAgain<'a>(&'a CoreList);

impl Drop for BoundAgain<'_> {
    fn drop(&mut self) {
        if let Err(why) = bind(self.0) {
            eprintln!("the sender may share cores with the sides: {why}");
        }
    }
}

fn bind(cores: &CoreList) -> Result<(), String> {
    bind_to(cores.cores()).map_err(|error| format!("cannot run on cores {cores}: {error}"))
}
