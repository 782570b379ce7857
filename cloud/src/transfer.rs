//! Files in the bodies of requests and answers.

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use axum::body::{Body, Bytes, HttpBody};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use futures_util::stream::try_unfold;
use futures_util::{Stream, StreamExt, TryStreamExt};
use gleaner_base::{Exit, Failure};
use gleaner_fleet::{AnnouncedFile, UnfinishedFile};
use sha2::{Digest, Sha256};
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::time::{Instant, timeout, timeout_at};

use crate::error::{CloudError, CloudResult};

pub(crate) const PIECE_TIME: Duration = Duration::from_secs(60);
/// Slowest rate of a whole file, in bytes/s.
const RATE_MIN: u64 = 14_000;
/// Time for a body that is not wanted, and its longest part that is read.
const UNWANTED_TIME: Duration = Duration::from_secs(30);
const UNWANTED_MAX: usize = 8 << 20;
/// Length of the pieces in which a file is sent.
const PIECE: usize = 64 << 10;

/// A file that a request sends, or a part of one.
#[derive(Debug, Clone, Copy)]
pub(crate) struct IncomingFile<'f> {
    /// Its name in messages.
    pub(crate) name: &'f str,
    pub(crate) length: u64,
}

impl IncomingFile<'_> {
    /// Receives it into a new file, with at most so much time for each piece. Without the right
    /// length and digest, nothing of it stays.
    pub(crate) async fn receive(
        self,
        sha256: &str,
        piece_time: Duration,
        path: PathBuf,
        body: Body,
    ) -> CloudResult<UnfinishedFile> {
        let (file, received, end) = self.receive_some(piece_time, path, body).await?;
        end?;
        received.finish(sha256).map_err(|reason| self.refused(reason))?;
        Ok(file)
    }

    /// Receives as much as comes; also returns the reason why the body did not end in time.
    pub(crate) async fn receive_some(
        self,
        piece_time: Duration,
        path: PathBuf,
        body: Body,
    ) -> CloudResult<(UnfinishedFile, AnnouncedFile, CloudResult<()>)> {
        let Self { name, length, .. } = self;
        let failed = |error: io::Error| {
            Failure::caused_by(Exit::Internal, format!("cannot store {name}"), &error)
        };
        let mut file = File::create_new(&path).await.map_err(failed)?;
        let part = UnfinishedFile(path);
        let (mut body, mut received) = (body.into_data_stream(), AnnouncedFile::new(length));
        let time = piece_time + Duration::from_secs(length / RATE_MIN);
        let until = Instant::now() + time;
        let end = loop {
            let piece = match timeout_at(until.min(Instant::now() + piece_time), body.next()).await
            {
                Err(_) if Instant::now() < until => break Err(self.late(piece_time)),
                Err(_) => break Err(self.late(time)),
                Ok(None) => break Ok(()),
                Ok(Some(Err(error))) => {
                    let message = format!("{name} did not come in full");
                    break Err(CloudError::usage(message, "send it again").because(error));
                }
                Ok(Some(Ok(piece))) => piece,
            };
            let before = received.received();
            let added = received.add(&piece);
            let fits = piece.slice(..(received.received() - before) as usize);
            file.write_all(&fits).await.map_err(failed)?;
            if let Err(reason) = added {
                break Err(self.refused(reason));
            }
        };
        file.flush().await.map_err(failed)?;
        Ok((part, received, end))
    }

    fn refused(&self, reason: String) -> CloudError {
        let help = "send it again, as it was announced";
        CloudError::denied(format!("{} is refused", self.name), help).because(reason)
    }

    fn late(&self, time: Duration) -> CloudError {
        let message = format!("{} came too slowly", self.name);
        CloudError::late(message, "send it again, over a faster connection")
            .because(format!("nothing, or not all of it, came within {} s", time.as_secs()))
    }
}

/// Reads the begin of a body that is not wanted: unread, it could hide the answer from its sender.
pub(crate) async fn skip(body: Body) {
    let pieces = body.into_data_stream().map_err(drop);
    let skipped =
        pieces.try_fold(UNWANTED_MAX, async |left, piece| left.checked_sub(piece.len()).ok_or(()));
    let _ = timeout(UNWANTED_TIME, skipped).await;
}

/// Bytes of a file, as many as have come of them.
#[derive(Debug)]
pub(crate) struct ReceivedPiece {
    pub(crate) file: UnfinishedFile,
    pub(crate) bytes: u64,
    pub(crate) sha256: String,
}

/// A stored file that an answer sends.
#[derive(Debug)]
pub(crate) struct OutgoingFile<'f> {
    /// Its name in messages.
    pub(crate) name: &'f str,
    /// Its media type.
    pub(crate) kind: &'static str,
    /// The way to get it, if it is not there.
    pub(crate) help: &'f str,
    pub(crate) sha256: Option<&'f str>,
}

impl OutgoingFile<'_> {
    /// Returns the answer with the file, or with the end of it that the header `Range` requests.
    /// `content` returns what begins at a byte; it and `length` are `None` if there is no file.
    /// The answer has `slot` until all of it is sent.
    pub(crate) async fn send(
        self,
        slot: impl Send + 'static,
        headers: &HeaderMap,
        length: io::Result<Option<u64>>,
        content: impl AsyncFnOnce(u64) -> io::Result<Option<Body>>,
    ) -> CloudResult<Response> {
        let Self { name, kind, help, sha256 } = self;
        let failed =
            |error| Failure::caused_by(Exit::Internal, format!("cannot send {name}"), &error);
        let missing =
            || CloudError::missing(format!("{name} is not among the files of the cloud"), help);
        let length = length.map_err(failed)?.ok_or_else(missing)?;
        let range = headers.get(header::RANGE).and_then(|it| it.to_str().ok());
        // Any other range is answered with the whole file, as the standard allows.
        let begin = range.and_then(|it| it.strip_prefix("bytes=")?.strip_suffix('-')?.parse().ok());
        let (begin, status) = match begin {
            Some(begin) if begin > 0 && begin < length => (begin, StatusCode::PARTIAL_CONTENT),
            Some(begin) if begin > 0 => {
                let range = (header::CONTENT_RANGE, format!("bytes */{length}"));
                return Ok((StatusCode::RANGE_NOT_SATISFIABLE, [range]).into_response());
            }
            _ => (0, StatusCode::OK),
        };
        let content = content(begin).await.map_err(failed)?.ok_or_else(missing)?;
        let stated = content.size_hint().exact();
        if let Some(stated) = stated.filter(|stated| *stated != length - begin) {
            let reason = format!("it has {stated} of {} bytes", length - begin);
            return Err(failed(io::Error::other(reason)).into());
        }
        let content = content.into_data_stream().map(move |piece| (piece, &slot).0);
        let stored = StoredBytes::new(name, length - begin);
        // The rest of a file has no digest: a client that goes on with a file has to compare all of
        // it.
        let stored = match sha256.filter(|_| begin == 0) {
            Some(sha256) => stored.with_sha256(sha256),
            None => stored,
        };
        let mut answer = stored.checked(Body::from_stream(content)).into_response();
        *answer.status_mut() = status;
        let mut set = |name, value: String| {
            if let Ok(value) = value.parse() {
                answer.headers_mut().insert(name, value);
            }
        };
        set(header::CONTENT_TYPE, kind.to_owned());
        set(header::X_CONTENT_TYPE_OPTIONS, "nosniff".to_owned());
        set(header::ACCEPT_RANGES, "bytes".to_owned());
        set(header::CONTENT_LENGTH, (length - begin).to_string());
        if status == StatusCode::PARTIAL_CONTENT {
            set(header::CONTENT_RANGE, format!("bytes {begin}-{}/{length}", length - 1));
        }
        Ok(answer)
    }
}

/// Bytes that a folder or a bucket should have. Neither is trusted: the one may be damaged, and the
/// other one belongs to another program.
#[derive(Debug, Clone)]
pub(crate) struct StoredBytes {
    name: String,
    length: u64,
    sha256: Option<String>,
}

impl StoredBytes {
    /// Returns those of this length, of any content.
    pub(crate) fn new(name: &str, length: u64) -> Self {
        Self { name: name.to_owned(), length, sha256: None }
    }

    pub(crate) fn with_sha256(self, sha256: &str) -> Self {
        Self { sha256: Some(sha256.to_owned()), ..self }
    }

    /// Returns a content that fails unless it is these bytes. The last piece comes only after the
    /// comparison, so that no reader takes other ones for whole.
    pub(crate) fn checked(self, content: Body) -> Body {
        self.checked_within(PIECE_TIME, content)
    }

    fn checked_within(self, piece_time: Duration, content: Body) -> Body {
        let Self { name, length, sha256 } = self;
        let check = ByteCheck { left: length, digest: sha256.map(|it| (Sha256::new(), it)) };
        let start = (content.into_data_stream(), Some(check));
        let pieces = try_unfold(start, move |(mut pieces, check)| async move {
            let Some(mut check) = check else { return Ok(None) };
            let piece = check.next(&mut pieces, piece_time).await?;
            check.count(&piece)?;
            if check.left > 0 {
                return Ok(Some((piece, (pieces, Some(check)))));
            }
            check.end(&mut pieces, piece_time).await?;
            Ok((!piece.is_empty()).then_some((piece, (pieces, None))))
        });
        Body::from_stream(pieces.inspect_err(move |reason: &String| {
            tracing::error!(file = name, reason, "a stored file cannot be sent");
        }))
    }
}

/// The comparison of bytes while they are sent.
struct ByteCheck {
    left: u64,
    digest: Option<(Sha256, String)>,
}

impl ByteCheck {
    /// Returns the next piece; an empty one at the end.
    async fn next(
        &self,
        pieces: &mut (impl Stream<Item = Result<Bytes, axum::Error>> + Unpin),
        time: Duration,
    ) -> Result<Bytes, String> {
        loop {
            let piece = timeout(time, pieces.next()).await;
            match piece.map_err(|_| format!("nothing came for {} s", time.as_secs()))? {
                None => return Ok(Bytes::new()),
                Some(Ok(piece)) if piece.is_empty() => {}
                Some(piece) => return piece.map_err(|error| error.to_string()),
            }
        }
    }

    fn count(&mut self, piece: &[u8]) -> Result<(), String> {
        if piece.is_empty() && self.left > 0 {
            return Err(format!("it ends {} bytes too early", self.left));
        }
        let left = self.left.checked_sub(piece.len() as u64);
        self.left = left.ok_or("it is too long")?;
        if let Some((digest, _)) = &mut self.digest {
            digest.update(piece);
        }
        Ok(())
    }

    async fn end(
        &mut self,
        pieces: &mut (impl Stream<Item = Result<Bytes, axum::Error>> + Unpin),
        time: Duration,
    ) -> Result<(), String> {
        if !self.next(pieces, time).await?.is_empty() {
            return Err("it is too long".to_owned());
        }
        let Some((digest, expected)) = self.digest.take() else { return Ok(()) };
        match gleaner_base::hex(&digest.finalize()) == expected {
            true => Ok(()),
            false => Err("it has another SHA-256".to_owned()),
        }
    }
}

/// Returns the rest of a file as the body of an answer, which is read piece by piece.
pub(crate) fn body_of(file: File) -> Body {
    Body::from_stream(try_unfold(file, async |mut file| {
        let mut piece = Vec::with_capacity(PIECE);
        (&mut file).take(PIECE as u64).read_to_end(&mut piece).await?;
        io::Result::Ok((!piece.is_empty()).then_some((piece, file)))
    }))
}

/// Media type of a file whose content does not matter.
pub(crate) const OCTETS: &str = "application/octet-stream";

#[cfg(test)]
mod tests {
    use axum::body::Bytes;
    use futures_util::stream;
    use tempfile::TempDir;

    use super::*;

    async fn refusal(
        pieces: impl futures_util::Stream<Item = io::Result<Bytes>> + Send + 'static,
    ) -> (StatusCode, String) {
        let folder = TempDir::new().unwrap();
        let sha256 = gleaner_trust::sha256(b"content");
        let file = IncomingFile { name: "the file x", length: 7 };
        let (path, body) = (folder.path().join("x.part"), Body::from_stream(pieces));
        let received = file.receive(sha256.as_str(), Duration::from_millis(20), path, body);
        let refused = received.await.unwrap_err();
        assert_eq!(folder.path().read_dir().unwrap().count(), 0, "nothing of it stays");
        (refused.status(), refused.reason())
    }

    #[tokio::test]
    async fn a_file_that_is_cut_off_or_too_slow_is_a_fault_of_the_client() {
        let piece = || stream::iter([Ok(Bytes::from_static(b"cont"))]);
        let (status, reason) = refusal(piece().chain(stream::pending())).await;
        assert_eq!(status, StatusCode::REQUEST_TIMEOUT);
        assert!(reason.starts_with("the file x came too slowly"), "{reason}");
        let lost = io::Error::other("the connection was lost");
        let (status, reason) = refusal(piece().chain(stream::iter([Err(lost)]))).await;
        assert_eq!(status, StatusCode::BAD_REQUEST);
        assert_eq!(reason, "the file x did not come in full: the connection was lost");
        let (status, reason) = refusal(piece()).await;
        assert_eq!(status, StatusCode::FORBIDDEN);
        assert!(reason.contains("it has 4 of 7 bytes"), "{reason}");
    }

    #[tokio::test]
    async fn a_file_with_pieces_in_time_that_never_ends_is_too_slow() {
        let drops = stream::repeat_with(|| Ok(Bytes::new())).then(async |piece| {
            tokio::time::sleep(Duration::from_millis(1)).await;
            piece
        });
        assert_eq!(refusal(drops).await.0, StatusCode::REQUEST_TIMEOUT);
    }

    /// Returns the content of an answer with bytes of a store that should be `content`, or the
    /// reason of its end.
    async fn sent(
        pieces: impl futures_util::Stream<Item = io::Result<Bytes>> + Send + 'static,
    ) -> Result<Vec<u8>, String> {
        let sha256 = gleaner_trust::sha256(b"content");
        let stored = StoredBytes::new("the file x", 7).with_sha256(sha256.as_str());
        let body = stored.checked_within(Duration::from_millis(20), Body::from_stream(pieces));
        let mut pieces = body.into_data_stream();
        let mut content = Vec::new();
        while let Some(piece) = pieces.next().await {
            content.extend(piece.map_err(|error| error.to_string())?);
            assert!(content.len() < 7 || content == b"content", "other bytes were sent in full");
        }
        Ok(content)
    }

    #[tokio::test]
    async fn bytes_of_a_store_that_are_other_ones_never_come_in_full() {
        let pieces = |all: &[&'static str]| {
            let all: Vec<_> = all.iter().map(|it| Ok(Bytes::from_static(it.as_bytes()))).collect();
            stream::iter(all)
        };
        assert_eq!(sent(pieces(&["con", "", "tent", ""])).await.unwrap(), b"content");
        for (wrong, reason) in [
            (&["conten"][..], "it ends 1 bytes too early"),
            (&[], "it ends 7 bytes too early"),
            (&["content", "s"], "it is too long"),
            (&["contents"], "it is too long"),
            (&["con", "tend"], "it has another SHA-256"),
        ] {
            assert_eq!(sent(pieces(wrong)).await.unwrap_err(), reason);
        }
        for stalls in [&["con"][..], &["con", "tent"]] {
            let stalled = sent(pieces(stalls).chain(stream::pending())).await.unwrap_err();
            assert!(stalled.starts_with("nothing came"), "{stalled}");
        }
        let lost = stream::iter([Err(io::Error::other("the connection was lost"))]);
        assert_eq!(
            sent(pieces(&["con"]).chain(lost)).await.unwrap_err(),
            "the connection was lost"
        );
    }

    #[tokio::test]
    async fn a_store_that_states_another_length_is_refused_before_an_answer_begins() {
        let file = OutgoingFile { name: "the file x", kind: OCTETS, help: "", sha256: None };
        let content = async |_| Ok(Some(Body::from("other")));
        let refused = file.send((), &HeaderMap::new(), Ok(Some(7)), content).await.unwrap_err();
        assert_eq!(refused.reason(), "cannot send the file x: it has 5 of 7 bytes");
    }
}
