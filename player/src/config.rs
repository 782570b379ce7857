//! The configuration of Cyclone DDS, unless the user sets one.

use std::net::IpAddr;

/// The configuration of Cyclone DDS as its own XML.
///
/// With the defaults of Cyclone DDS a frame of 25 MB is 18,600 fragments of 1344 bytes, of which a
/// reader with an ordinary socket buffer loses many; with these settings it is 400. A writer blocks
/// while more than `WhcHigh` is not acknowledged: ten frames of 25 MB are below it. A sample larger
/// than `MaxQueuedRexmitBytes` could never be retransmitted; one larger than `MaxRexmit` is
/// retransmitted in several rounds, each as long as the reader's NACK delay.
pub(crate) fn xml(interface: Option<IpAddr>) -> String {
    let interfaces = match interface {
        Some(address) => {
            format!("<Interfaces><NetworkInterface address=\"{address}\"/></Interfaces>")
        }
        None => String::new(),
    };
    format!(
        "<CycloneDDS><Domain id=\"any\"><General>{interfaces}\
           <MaxMessageSize>65500B</MaxMessageSize>\
           <MaxRexmitMessageSize>65500B</MaxRexmitMessageSize>\
           <FragmentSize>63000B</FragmentSize>\
         </General><Internal>\
           <SocketSendBufferSize max=\"8MiB\"/>\
           <BurstSize><MaxRexmit>32MiB</MaxRexmit></BurstSize>\
           <MaxQueuedRexmitBytes>64MiB</MaxQueuedRexmitBytes>\
           <Watermarks>\
             <WhcAdaptive>false</WhcAdaptive>\
             <WhcHigh>256MiB</WhcHigh><WhcHighInit>256MiB</WhcHighInit><WhcLow>64MiB</WhcLow>\
           </Watermarks>\
         </Internal></Domain></CycloneDDS>"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interface_is_configured_only_on_request() {
        assert!(!xml(None).contains("Interface"));
        assert!(
            xml(Some("127.0.0.1".parse().unwrap()))
                .contains("<NetworkInterface address=\"127.0.0.1\"/>")
        );
        assert!(xml(Some("fe80::1".parse().unwrap())).contains("\"fe80::1\""));
    }

    #[test]
    fn the_documented_configuration_is_the_one_in_use() {
        let page = include_str!("../../docs/play.md");
        let documented =
            page.split_once("```xml\n").and_then(|(_, rest)| rest.split_once("```")).unwrap().0;
        assert_eq!(documented.lines().map(str::trim).collect::<String>(), xml(None));
    }
}
