//! Clips are wanted, sent to people, and removed by them.

use axum::http::HeaderMap;
use axum::response::Response;
use gleaner_base::{Exit, Failure};
use gleaner_fleet::clips::{ClipId, ClipPolicy, ClipState, FleetClip};

use super::{FileOfClip, FleetClips};
use crate::error::{CloudError, CloudResult};
use crate::transfer::{OCTETS, OutgoingFile};

impl FleetClips {
    /// Marks a clip as wanted. The vehicle sends it when it is connected and has bytes left for
    /// today.
    pub(crate) async fn pull(&self, actor: &str, id: &ClipId) -> CloudResult<FleetClip> {
        let before = self.store.clip(id).await?;
        // Only a file that was stored before this look can be lost: another one may arrive
        // meanwhile.
        let is_lost = before.state == ClipState::Stored && {
            let parts = self.store.clip_parts(id).await?;
            let failed = |error| {
                Failure::caused_by(Exit::Internal, format!("cannot send clip `{id}`"), &error)
            };
            !self.files.has_recording(id, &parts).await.map_err(failed)?
        };
        let clip = self.store.pull_clip(actor, before, is_lost).await?;
        self.hub.wake(&[id.vehicle().to_owned()]);
        Ok(clip)
    }

    /// Removes a clip. A kill before its files are removed loses nothing: they go with the next
    /// look.
    pub(crate) async fn remove(&self, actor: &str, id: ClipId) -> CloudResult<()> {
        self.store.remove_clip(actor, &id).await?;
        self.remove_files_of(id).await.map(drop)
    }

    pub(crate) async fn set_policy(&self, actor: &str, policy: &ClipPolicy) -> CloudResult<()> {
        let vehicles = self.store.set_clip_policy(actor, policy).await?;
        self.hub.wake(&vehicles);
        Ok(())
    }

    /// Returns the answer with the thumbnail of a clip.
    pub(crate) async fn thumbnail(&self, id: &ClipId) -> CloudResult<Response> {
        let clip = self.store.clip(id).await?;
        if !clip.has_thumbnail {
            let message = format!("clip `{id}` has no thumbnail here");
            return Err(CloudError::missing(message, "its vehicle sends it when it is connected"));
        }
        let file = (id, FileOfClip::Thumbnail, clip.facts.thumbnail.as_deref());
        self.send(file, "image/jpeg", &HeaderMap::new(), ()).await
    }

    /// Returns the answer with the file of a clip; it has `slot` until all of it is sent.
    pub(crate) async fn recording(
        &self,
        id: &ClipId,
        headers: &HeaderMap,
        slot: impl Send + 'static,
    ) -> CloudResult<Response> {
        let clip = self.store.clip(id).await?;
        if clip.state != ClipState::Stored {
            let message =
                format!("the file of clip `{id}` is not in the cloud: {}", clip.state.as_str());
            return Err(CloudError::missing(message, "fetch it: `gleaner clips pull ID`"));
        }
        let file = FileOfClip::Recording(clip.facts.bytes, self.store.clip_parts(id).await?);
        self.send((id, file, clip.facts.sha256.as_deref()), OCTETS, headers, slot).await
    }

    /// Returns the answer with a file, or with the end of it that `Range` asks for.
    async fn send(
        &self,
        (id, file, sha256): (&ClipId, FileOfClip, Option<&str>),
        kind: &'static str,
        headers: &HeaderMap,
        slot: impl Send + 'static,
    ) -> CloudResult<Response> {
        let name = format!("a file of clip `{id}`");
        let help = "fetch it again: `gleaner clips pull ID`";
        let length = self.files.length(id, &file).await;
        let content = async |begin| self.files.content(id, file, begin).await;
        OutgoingFile { name: &name, kind, help, sha256 }.send(slot, headers, length, content).await
    }
}
