//! The place of `scaled` in a program that is built without that feature: it refuses both options.

use std::io;
use std::path::Path;
use std::sync::Arc;

use axum::body::Body;
use gleaner_base::{Exit, Failure};
use tokio::task::JoinSet;

use crate::bus::{Bus, ReceivedHints};

pub(crate) use Unavailable as BusAddress;
pub(crate) use Unavailable as S3Bucket;

#[derive(Debug, Clone)]
pub(crate) enum Unavailable {}

impl Unavailable {
    pub(crate) fn parse(_: &str) -> Result<Self, Failure> {
        let message = "this program was built without the feature scaled; --bus and --objects \
                       cannot be used";
        Err(Failure::new(Exit::Usage, message)
            .with_help("leave them out, or build gleaner-cloud with `--features scaled`"))
    }

    pub(crate) fn url(&self) -> String {
        match *self {}
    }
}

macro_rules! never {
    ($($name:ident($($value:ty),*) -> $result:ty;)+) => {
        impl Unavailable {
            $(pub(crate) async fn $name(&self, $(_: $value),*) -> $result { match *self {} })+
        }
    };
}

never! {
    connect(&str, &mut JoinSet<()>) -> Result<(Bus, Arc<ReceivedHints>), Failure>;
    put(&str, &Path) -> io::Result<()>;
    length(&str) -> io::Result<Option<u64>>;
    content(&str, u64) -> io::Result<Option<Body>>;
    remove(&str) -> io::Result<()>;
    list(&str) -> io::Result<Vec<String>>;
}

#[test]
fn options_of_the_feature_are_refused_with_the_way_out() {
    let failure = S3Bucket::parse("s3://bucket/prefix").unwrap_err();
    assert_eq!(failure.exit, Exit::Usage);
    let text = failure.to_string();
    assert!(text.contains("--objects") && text.contains("--features scaled"), "{text}");
}
