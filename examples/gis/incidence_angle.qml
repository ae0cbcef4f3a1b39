<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<!-- incidence_angle of a cloud of wavebatch, for point cloud layers of QGIS 3.32 or later. No-data (-9999) is not drawn. -->
<qgis styleCategories="Symbology" version="3.32.0">
  <renderer type="ramp" attribute="incidence_angle" min="0" max="70" pointSize="1" pointSizeUnit="MM">
    <colorrampshader colorRampType="INTERPOLATED" classificationMode="1" clip="1" minimumValue="0" maximumValue="70">
      <item label="less" value="-9998" color="#440154" alpha="255"/>
      <item label="0" value="0" color="#440154" alpha="255"/>
      <item label="17.5" value="17.5" color="#3b528b" alpha="255"/>
      <item label="35" value="35" color="#21918c" alpha="255"/>
      <item label="52.5" value="52.5" color="#5ec962" alpha="255"/>
      <item label="70" value="70" color="#fde725" alpha="255"/>
      <item label="more" value="1000000000" color="#fde725" alpha="255"/>
      <rampLegendSettings useContinuousLegend="0"/>
    </colorrampshader>
  </renderer>
</qgis>
