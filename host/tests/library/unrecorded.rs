//! Live runs without a recorder, and with a connection to it that is none.

use std::fs::File;
use std::io::pipe;
use std::net::{TcpListener, TcpStream};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;

use gleaner_base::Exit;
use gleaner_protocol::link::{LambdaLink, LambdaMessage};

use crate::live::Running;

/// The lambda's end of a connection that is closed already.
fn closed() -> OwnedFd {
    UnixStream::pair().unwrap().0.into()
}

#[test]
fn a_run_decides_without_a_recorder_and_its_wakes_wait_for_one() {
    let mut running = Running::begin(None, Some(closed()));
    running.until_ready();
    running.publish(3);
    assert_eq!(running.decided(), 3.0);
    // Another one that has ended before it was joined.
    running.pass_recorder(closed());
    running.publish(4);
    assert_eq!(running.decided(), 4.0);
    let live = running.live(|live| live.recorder_link.is_some_and(|link| link.absent_s > 0));
    let link = live.recorder_link.unwrap();
    assert_eq!((link.wakes_dropped, link.triggers_lost), (0, 0), "they are kept for a minute");
    let (lambda_end, recorder_end) = UnixStream::pair().unwrap();
    let (mut link, mut replies) = LambdaLink::new(recorder_end.into()).unwrap();
    running.pass_recorder(lambda_end.into());
    assert!(matches!(link.receive(), Ok(Some(LambdaMessage::Hello(_)))));
    replies.ready();
    for expected in [3.0, 4.0] {
        let received = link.receive();
        let Ok(Some(LambdaMessage::Wake { entry, missing: 0, .. })) = received else {
            panic!("{received:?}");
        };
        assert_eq!(entry.triggers[0].score, Some(expected));
    }
    running.live(|live| live.recorder_link.is_some_and(|link| link.absent_s == 0));
    let (ended, _) = running.stop();
    assert_eq!(ended.unwrap(), Exit::Ok);
}

#[test]
fn a_connection_that_is_none_ends_the_run_with_an_error_that_names_it() {
    let null = || OwnedFd::from(File::open("/dev/null").unwrap());
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let silent = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    let (pipe, _writer) = pipe().unwrap();
    for (connection, cause) in [
        (null(), "on non-socket"),
        (pipe.into(), "on non-socket"),
        (silent.into(), "it is not a Unix socket"),
        (listener.into(), "it is not a Unix socket"),
    ] {
        let failure = Running::begin(None, Some(connection)).ended().unwrap_err();
        let text = failure.to_string();
        assert!(text.contains("the connection to the recorder failed"), "{text}");
        assert!(text.contains(cause), "{text}");
    }
    // Later, too.
    let mut running = Running::begin(None, Some(closed()));
    running.until_ready();
    running.publish(3);
    assert_eq!(running.decided(), 3.0);
    running.pass_recorder(null());
    let text = running.ended().unwrap_err().to_string();
    assert!(text.contains("the connection to the recorder failed"), "{text}");
}
