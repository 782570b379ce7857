//! Clips: announced by vehicles, wanted by people, and sent in parts.
//!
//! `vehicles` receives announcements and parts, `people` lists clips and sends their files, and
//! `files` has these. A vehicle reads the complete list of what is wanted: there is no command that
//! could be lost or come twice. Nothing here deletes anything on a vehicle.

mod files;
pub(crate) mod people;
#[cfg(test)]
mod tests;
mod vehicles;

use std::time::Duration;

use tokio::time::interval;

pub(crate) use files::{ClipFiles, FileOfClip};
pub(crate) use vehicles::router;

use crate::cloud::Cloud;

/// Interval of looks for unfinished files that are not continued.
const CLEANING: Duration = Duration::from_secs(600);

/// Removes unfinished files that are not continued, for as long as the program runs.
pub(crate) async fn clean(cloud: &Cloud) {
    let mut looks = interval(CLEANING);
    loop {
        looks.tick().await;
        let forgotten = cloud.store.forget_unfinished_clips(cloud.clips.bounds.unfinished_s).await;
        match forgotten {
            Ok(forgotten) => {
                for id in forgotten {
                    let _turn = cloud.clips.turn(&id).await;
                    cloud.clips.remove_recording(&id).await;
                }
            }
            Err(error) => {
                tracing::warn!(reason = error.reason(), "unfinished clips are not removed");
            }
        }
    }
}
