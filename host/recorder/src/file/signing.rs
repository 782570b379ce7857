//! The statement that the recorder signs with a clip.

use std::time::{SystemTime, UNIX_EPOCH};

use gleaner_base::Failure;
use gleaner_journal::JournalHeader;
use gleaner_lambda::{Clip, ClipLambda, ClipTopic};
use gleaner_trust::{
    ClipLosses, ClipSigner, ClipStatement, MEDIA_TYPE, Payload, Refusal, SIGNATURE, SignedFile,
    SignedLambda, sha256,
};
use tracing::error;

use super::ClipTrailer;
use super::clip_dir::ClipDir;
use super::clip_records::{LIBRARY, journal, json};

/// Name and media type of the attachment with the signature.
pub(super) const ATTACHMENT: (&str, &str) = (SIGNATURE, MEDIA_TYPE);

/// Returns the statement about a clip, with the digest of no bytes in the place of the file's.
///
/// # Errors
///
/// [`Refusal`] for names that no lambda has, in the file of a dead recorder.
pub(super) fn statement(
    signer: &ClipSigner,
    trailer: &ClipTrailer,
    clip: &Clip,
    clock: &str,
) -> Result<ClipStatement, Refusal> {
    let name = clip.file.file_stem().unwrap_or_default().to_string_lossy();
    let header = |index: usize| trailer.headers.get(index).map(AsRef::as_ref);
    let lambdas = clip.lambdas.iter().enumerate();
    let journals = trailer.journals.iter();
    // No vehicle is trusted for its clock.
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Ok(ClipStatement {
        vehicle: signer.vehicle().clone(),
        clip: name.into_owned(),
        created: now.as_secs(),
        recorder: LIBRARY.to_owned(),
        sha256: sha256(b""),
        clock: clock.to_owned(),
        from_ns: clip.from_ns,
        to_ns: clip.to_ns,
        messages: clip.topics.iter().map(|topic| topic.messages).sum(),
        triggers: clip.triggers,
        lambdas: lambdas
            .map(|(index, entry)| lambda(entry, header(index)))
            .collect::<Result<_, _>>()?,
        journals: journals
            .map(|(name, bytes)| SignedFile { name: journal(name), sha256: sha256(bytes) })
            .collect(),
        losses: losses(clip),
        recovered: clip.recovered.is_some(),
    })
}

fn lambda(entry: &ClipLambda, header: Option<&JournalHeader>) -> Result<SignedLambda, Refusal> {
    let models = header.map_or(&[][..], |header| &header.models).iter();
    let models = models.map(|model| {
        let sha256 = parsed(&model.sha256)?;
        Ok(SignedFile { name: model.path.clone(), sha256 })
    });
    Ok(SignedLambda {
        name: parsed(&entry.name)?,
        version: parsed(&entry.version)?,
        kind: entry.kind,
        digest: parsed(&entry.digest)?,
        engine: header.map(|header| header.engine.clone()),
        config: header.map(|header| sha256(json(&header.config).as_bytes())),
        models: models.collect::<Result<_, Refusal>>()?,
    })
}

fn parsed<T: std::str::FromStr<Err: ToString>>(text: &str) -> Result<T, Refusal> {
    text.parse().map_err(|error: T::Err| Refusal::Malformed {
        what: ClipStatement::NAME,
        reason: error.to_string(),
    })
}

fn losses(clip: &Clip) -> ClipLosses {
    let sum = |count: fn(&ClipTopic) -> Option<u64>| {
        clip.topics
            .iter()
            .map(count)
            .try_fold(0, |sum: u64, count| Some(sum.saturating_add(count?)))
    };
    ClipLosses {
        lost: sum(|topic| topic.lost),
        overwritten: sum(|topic| topic.overwritten),
        too_big: sum(|topic| topic.too_big),
        reasons: clip.incomplete.len() as u64,
    }
}

/// Counts and logs a clip that is written without a signature.
pub(super) fn failed(dir: &ClipDir, clip: &Clip, refusal: &Refusal) {
    dir.count_unsigned();
    let reason = Failure::from(refusal.clone()).message;
    error!(clip = %clip.file.display(), %reason, "cannot sign a clip; it has no signature");
}
