//! Vehicles announce their clips and send them.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use axum::body::{Body, Bytes};
use futures_util::TryStreamExt;
use gleaner_base::{Exit, Failure};
use gleaner_fleet::clips::{
    CLIP_PIECE_MIN, CLIPS_IN_REPORT, ClipFacts, ClipId, ClipName, ClipOrders, ClipReport,
    THUMBNAIL_MAX,
};
use gleaner_pixels::Format;

use super::FleetClips;
use crate::error::{CloudError, CloudResult};
use crate::readers::ReaderSlot;
use crate::store::{ClipProgress, StoredPart};
use crate::transfer::{ReceivedPiece, skip};

/// Longest position in the list of a vehicle.
const CURSOR_MAX: usize = 256;
/// The reason of a failed upload whose earlier parts were lost.
const NO_PARTS: &str = "its first parts are gone";
/// Largest side of a thumbnail, in pixels: a few KiB could claim more than a browser has memory
/// for.
const SIDE_MAX: u32 = 4096;

impl FleetClips {
    /// Stores a report; returns everything that is wanted.
    pub(crate) async fn announce(
        &self,
        vehicle: &str,
        report: &ClipReport,
    ) -> CloudResult<ClipOrders> {
        let refused = |reason: String| {
            let help = "use a version of gleaner that fits the one of the cloud";
            CloudError::usage("the report of clips is refused", help).because(reason)
        };
        if report.clips.len() > CLIPS_IN_REPORT
            || report.gone.len() > CLIPS_IN_REPORT
            || report.cursor.as_ref().is_some_and(|it| it.len() > CURSOR_MAX)
        {
            return Err(refused("it is too long".to_owned()));
        }
        report.clips.iter().try_for_each(ClipFacts::check).map_err(refused)?;
        // A vehicle whose name is no safe part of a path has no clips here.
        if let Some(first) = report.clips.first() {
            ClipId::new(first.name.clone(), vehicle).map_err(refused)?;
        }
        if *report != ClipReport::default() {
            self.store.announce_clips(vehicle, report, self.files.bounds).await?;
        }
        self.orders(vehicle).await
    }

    async fn orders(&self, vehicle: &str) -> CloudResult<ClipOrders> {
        self.store.clip_orders(vehicle, self.files.bounds).await
    }

    pub(crate) async fn receive_thumbnail(
        &self,
        vehicle: &str,
        name: &ClipName,
        body: Bytes,
    ) -> CloudResult<ClipOrders> {
        let length = body.len() as u64;
        let file = format!("the thumbnail of clip `{name}`");
        let file = (&*file, Some(THUMBNAIL_MAX));
        let fits = self.store.must_fit(vehicle, file, self.files.bounds).await;
        self.store.clip_bytes_arrived(vehicle, length).await?;
        let Some(wanted) = self.store.wanted_thumbnail(vehicle, name).await? else {
            return self.orders(vehicle).await;
        };
        fits?;
        let id = ClipId::new(name.clone(), vehicle)
            .map_err(|reason| CloudError::usage(reason, "enrol the vehicle under another name"))?;
        if gleaner_trust::sha256(&body).as_str() != wanted || !is_thumbnail(&body) {
            // It will never be the announced one.
            self.store.thumbnail_refused(&id, &wanted).await?;
            let help = "announce a JPEG of at most 4096 pixels a side, and send that one";
            let message = format!("the thumbnail of clip `{id}` is refused");
            return Err(CloudError::denied(message, help));
        }
        let part = self.files.receive(&id, length, Body::from(body)).await?;
        let _turn = self.files.turn(&id).await;
        // Otherwise the clip was removed meanwhile, or another request has sent it.
        if self.store.wanted_thumbnail(vehicle, name).await?.is_some() {
            let kept = self.files.keep_thumbnail(&id, &part.file).await;
            kept.map_err(|error| not_stored(&id, error))?;
            self.store.thumbnail_received(&id, length).await?;
        }
        self.orders(vehicle).await
    }

    /// Receives a piece of a clip that begins at a byte, and counts what arrives, whatever becomes
    /// of it. What has come of one that breaks off is kept; one that was received before, or that
    /// has no slot, changes nothing.
    pub(crate) async fn receive_piece(
        &self,
        vehicle: &str,
        slot: CloudResult<ReaderSlot>,
        piece: (ClipName, u64),
        body: Body,
    ) -> CloudResult<ClipOrders> {
        let arrived = Arc::new(AtomicU64::new(0));
        let counter = Arc::clone(&arrived);
        let pieces = body.into_data_stream().inspect_ok(move |piece| {
            counter.fetch_add(piece.len() as u64, Ordering::Relaxed);
        });
        let (clips, name) = (self.clone(), vehicle.to_owned());
        // A vehicle that goes away in the middle must not leave it half done.
        let stored = tokio::spawn(async move {
            let stored = clips.store_piece(&name, slot, piece, Body::from_stream(pieces)).await;
            let arrived = arrived.load(Ordering::Relaxed);
            stored.and(clips.store.clip_bytes_arrived(&name, arrived).await)
        });
        stored.await.map_err(|error| {
            Failure::caused_by(Exit::Internal, "a part of a clip is not stored", &error)
        })??;
        self.orders(vehicle).await
    }

    /// Stores a piece, if some of it comes next.
    async fn store_piece(
        &self,
        vehicle: &str,
        slot: CloudResult<ReaderSlot>,
        (name, begin): (ClipName, u64),
        body: Body,
    ) -> CloudResult<()> {
        let wanted = match &slot {
            Ok(_) => self.expected(vehicle, &name, begin).await,
            Err(busy) => Err(busy.clone()),
        };
        let Ok(Some((progress, length))) = wanted else {
            skip(body).await;
            return wanted.map(drop);
        };
        // Some of it may have come before.
        let mut left = progress.received - begin;
        let length = length - left;
        let pieces = body.into_data_stream().map_ok(move |mut piece| {
            let skipped = left.min(piece.len() as u64);
            left -= skipped;
            piece.split_off(skipped as usize)
        });
        let body = Body::from_stream(pieces);
        let received = self.files.receive(&progress.id, length, body).await?;
        self.append_piece(&name, progress, received).await
    }

    /// Returns the clip and the largest length of a piece, if the next byte is in it.
    async fn expected(
        &self,
        vehicle: &str,
        name: &ClipName,
        begin: u64,
    ) -> CloudResult<Option<(ClipProgress, u64)>> {
        let progress = self.store.clip_progress(vehicle, name, self.files.bounds).await?;
        let length = ClipFacts::piece_length(progress.bytes, begin).ok_or_else(|| {
            let message = format!("clip `{}` has no byte {begin}", progress.id);
            CloudError::usage(message, "send the next bytes of the orders")
        })?;
        let is_next = (begin..begin + length).contains(&progress.received);
        Ok(is_next.then_some((progress, length)))
    }

    /// Appends a piece, and compares the file after the last one.
    async fn append_piece(
        &self,
        name: &ClipName,
        progress: ClipProgress,
        received: ReceivedPiece,
    ) -> CloudResult<()> {
        let id = progress.id.clone();
        let _turn = self.files.turn(&id).await;
        let bounds = self.files.bounds;
        let now = self.store.clip_progress(id.vehicle(), name, bounds).await?;
        let is_last = now.received + received.bytes == now.bytes;
        // Another request may have stored a piece meanwhile. Each costs an entry, and in a bucket
        // an object.
        if now != progress || (received.bytes < CLIP_PIECE_MIN && !is_last) {
            return Ok(());
        }
        let failed = |error| not_stored(&id, error);
        let part = StoredPart { sha256: received.sha256.clone(), bytes: received.bytes };
        let is_appended = self.files.append(&now, received).await.map_err(failed)?;
        let outcome = match (is_appended, is_last) {
            (false, _) => Err(NO_PARTS.to_owned()),
            (true, false) => Ok(()),
            (true, true) => {
                let announced = (now.bytes, now.sha256.clone());
                let mut parts = self.store.clip_parts(&id).await?;
                parts.push(part.clone());
                match self.files.compare(&id, announced, parts).await {
                    Err(error) if error.kind() == io::ErrorKind::NotFound => {
                        Err(NO_PARTS.to_owned())
                    }
                    compared => compared.map_err(failed)?,
                }
            }
        };
        let Err(reason) = outcome else {
            let part = (part.bytes, &*part.sha256);
            return self.store.clip_part_received(&now, part, is_last, bounds).await;
        };
        // Otherwise another replica has stored it meanwhile.
        if self.store.clip_upload_failed(&id, &reason).await? {
            self.remove_noted(id.clone()).await?;
        }
        let message = format!("the file of clip `{id}` is refused");
        Err(CloudError::denied(message, "send it again from its first byte").because(reason))
    }
}

/// Returns whether bytes begin as a JPEG of a size that a browser can show.
pub(crate) fn is_thumbnail(bytes: &[u8]) -> bool {
    bytes.len() as u64 <= THUMBNAIL_MAX
        && gleaner_pixels::probe(bytes).is_ok_and(|image| {
            image.format == Format::Jpeg && image.width.max(image.height) <= SIDE_MAX
        })
}

fn not_stored(id: &ClipId, error: io::Error) -> CloudError {
    Failure::caused_by(Exit::Internal, format!("cannot store clip `{id}`"), &error).into()
}
