//! Files in the bodies of requests and answers.

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use axum::body::Body;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt;
use gleaner_base::{Exit, Failure};
use gleaner_fleet::{AnnouncedFile, UnfinishedFile};
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::time::timeout;

use crate::error::{CloudError, CloudResult};

/// Time for the next piece of a file.
pub(crate) const PIECE_TIME: Duration = Duration::from_secs(60);
/// Slowest rate of a whole file, in bytes/s.
const RATE_MIN: u64 = 14_000;
/// Length of the pieces in which a file is sent.
const PIECE: usize = 64 << 10;

/// A file that a request sends, or a part of one.
#[derive(Debug, Clone, Copy)]
pub(crate) struct IncomingFile<'f> {
    /// Its name in messages.
    pub(crate) name: &'f str,
    pub(crate) length: u64,
    pub(crate) sha256: &'f str,
}

impl IncomingFile<'_> {
    /// Receives it into a new file. Without the right length and digest, nothing of it stays.
    pub(crate) async fn receive(self, path: PathBuf, body: Body) -> CloudResult<UnfinishedFile> {
        self.receive_within(PIECE_TIME, path, body).await
    }

    async fn receive_within(
        self,
        piece_time: Duration,
        path: PathBuf,
        body: Body,
    ) -> CloudResult<UnfinishedFile> {
        let time = piece_time + Duration::from_secs(self.length / RATE_MIN);
        let receive = self.receive_in_time(piece_time, path, body);
        timeout(time, receive).await.unwrap_or_else(|_| Err(self.late(time)))
    }

    async fn receive_in_time(
        self,
        piece_time: Duration,
        path: PathBuf,
        body: Body,
    ) -> CloudResult<UnfinishedFile> {
        let Self { name, length, sha256 } = self;
        let failed = |error: io::Error| {
            Failure::caused_by(Exit::Internal, format!("cannot store {name}"), &error)
        };
        let refused = |reason: String| {
            let help = "send it again, as it was announced";
            CloudError::denied(format!("{name} is refused"), help).because(reason)
        };
        let mut file = File::create_new(&path).await.map_err(failed)?;
        let part = UnfinishedFile(path);
        let mut announced = AnnouncedFile::new(length, sha256);
        let mut body = body.into_data_stream();
        loop {
            let piece = timeout(piece_time, body.next()).await;
            let Some(piece) = piece.map_err(|_| self.late(piece_time))? else { break };
            let piece = piece.map_err(|error| {
                let message = format!("{name} did not come in full");
                CloudError::usage(message, "send it again").because(error)
            })?;
            announced.add(&piece).map_err(refused)?;
            file.write_all(&piece).await.map_err(failed)?;
        }
        announced.finish().map_err(refused)?;
        file.flush().await.map_err(failed)?;
        Ok(part)
    }

    fn late(&self, time: Duration) -> CloudError {
        let message = format!("{} came too slowly", self.name);
        CloudError::late(message, "send it again, over a faster connection")
            .because(format!("nothing, or not all of it, came within {} s", time.as_secs()))
    }
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
}

impl OutgoingFile<'_> {
    /// Returns the answer with the file, or with the end of it that the header `Range` requests.
    /// `content` returns what begins at a byte; it and `length` are `None` if there is no file.
    pub(crate) async fn send(
        self,
        headers: &HeaderMap,
        length: io::Result<Option<u64>>,
        content: impl AsyncFnOnce(u64) -> io::Result<Option<Body>>,
    ) -> CloudResult<Response> {
        let Self { name, kind, help } = self;
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
        let mut answer = content.into_response();
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

/// Returns the rest of a file as the body of an answer, which is read piece by piece.
pub(crate) fn body_of(file: File) -> Body {
    Body::from_stream(futures_util::stream::try_unfold(file, async |mut file| {
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
        let file = IncomingFile { name: "the file x", length: 7, sha256: sha256.as_str() };
        let (path, body) = (folder.path().join("x.part"), Body::from_stream(pieces));
        let refused = file.receive_within(Duration::from_millis(20), path, body).await.unwrap_err();
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
}
